#define _POSIX_C_SOURCE 200809L

#include <arpa/inet.h>
#include <fcntl.h>
#include <math.h>
#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#include "stewart_example.h"
#include "udp.h"

#define SHORTEST_KEY 16
#define LONGEST_KEY 4096
#ifndef UDP_RANDOM
#define UDP_RANDOM "/dev/urandom"
#endif

uint64_t udp_now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (uint64_t)t.tv_sec * SECOND + (uint64_t)t.tv_nsec;
}

int udp_draw(void *bytes, size_t size)
{
    FILE *file = fopen(UDP_RANDOM, "rb");
    int drawn = file && fread(bytes, size, 1, file) == 1;
    if (file)
        fclose(file);
    if (!drawn)
        fprintf(stderr, "%s: no random bytes; expected them for session and nonce\n", UDP_RANDOM);
    return drawn;
}

int udp_open(uint16_t port, stewart_key key)
{
    struct sockaddr_in at = {.sin_family = AF_INET, .sin_port = htons(port)};
    at.sin_addr.s_addr = htonl(key.size ? INADDR_ANY : INADDR_LOOPBACK);
    int s = socket(AF_INET, SOCK_DGRAM, 0);
    if (s >= 0 && (fcntl(s, F_SETFL, O_NONBLOCK) < 0 ||
                   bind(s, (struct sockaddr *)&at, sizeof at) < 0)) {
        close(s);
        s = -1;
    }
    if (s < 0)
        perror("port");
    return s;
}

int udp_help(int argc, char **argv, const char *usage)
{
    int asked = argc > 1 && (strcmp(argv[1], "--help") == 0 || strcmp(argv[1], "-h") == 0);
    if (asked)
        printf("usage: %s\n", usage);
    return asked;
}

double udp_number(const char *name, const char *text, double most, int parts)
{
    char *end;
    double number = strtod(text, &end);
    if (end != text && !*end && number > 0 && number <= most && (parts || number == floor(number)))
        return number;
    fprintf(stderr, "%s: got %s; expected a%s number above 0 and up to %.0f\n", name, text,
            parts ? "" : " whole", most);
    return 0;
}

void udp_wait(int socket, uint64_t until)
{
    struct pollfd watched = {.fd = socket, .events = POLLIN};
    uint64_t now = udp_now();
    /* Whole ms, up: the last of them is waited for by the clock. */
    uint64_t wait = until > now ? (until - now) / 1000000u : 0;
    if (poll(&watched, 1, wait > 1000u ? 1000 : (int)wait) != 0 || wait > 0 || until <= now)
        return;
    struct timespec rest = {0, (long)(until - now)};
    nanosleep(&rest, NULL);
}

int udp_get(int socket, uint8_t *data, size_t *size, struct sockaddr_in *from)
{
    socklen_t length = sizeof *from;
    ssize_t got = recvfrom(socket, data, STEWART_LONGEST + 1, 0, (struct sockaddr *)from, &length);
    *size = got > 0 ? (size_t)got : 0;
    return got >= 0;
}

int udp_put(int socket, const uint8_t *data, size_t size, const struct sockaddr_in *to)
{
    return sendto(socket, data, size, 0, (const struct sockaddr *)to, sizeof *to) == (ssize_t)size;
}

int udp_same(const struct sockaddr_in *one, const struct sockaddr_in *other)
{
    return one->sin_port == other->sin_port && one->sin_addr.s_addr == other->sin_addr.s_addr;
}

stewart_key udp_key(const char *path)
{
    static uint8_t bytes[LONGEST_KEY + 1];
    stewart_key key = {bytes, 0};
    FILE *file = path ? fopen(path, "rb") : NULL;
    if (file) {
        key.size = fread(bytes, 1, sizeof bytes, file);
        fclose(file);
    }
    if (path && !file) {
        fprintf(stderr, "%s: cannot be read; expected a file with a key\n", path);
        return key;
    }
    while (key.size && (bytes[key.size - 1] == '\n' || bytes[key.size - 1] == '\r'))
        key.size--;
    if (path && (key.size < SHORTEST_KEY || key.size > LONGEST_KEY)) {
        fprintf(stderr, "%s: got %s%u bytes; expected a key of %d to %d\n", path,
                key.size > LONGEST_KEY ? "at least " : "", (unsigned)key.size, SHORTEST_KEY, LONGEST_KEY);
        key.size = 0;
    }
    return key;
}

uint64_t udp_nonce(const stewart_offers *offers, uint64_t session, const struct sockaddr_in *from)
{
    return stewart_nonce(offers, session, ntohl(from->sin_addr.s_addr), ntohs(from->sin_port));
}

static volatile sig_atomic_t interrupted;

static void interrupt(int number)
{
    (void)number;
    interrupted = 1;
}

int udp_interrupted(void)
{
    static int asked;
    if (!asked) {
        struct sigaction action;
        memset(&action, 0, sizeof action);
        action.sa_handler = interrupt;
        sigaction(SIGINT, &action, NULL);
        sigaction(SIGTERM, &action, NULL);
        asked = 1;
    }
    return interrupted;
}

void udp_tell(const unsigned *refused)
{
    static const char *const names[STEWART_REFUSALS] = {
        "", "malformed", "version", "key", "foreign", "replayed", "late", "rate"};
    printf("refused:");
    for (int i = 1; i < STEWART_REFUSALS; i++)
        printf(" %u %s%s", refused[i], names[i], i + 1 < STEWART_REFUSALS ? "," : "\n");
}

static size_t put_reason(const stewart_reason *reason, char *text, size_t size)
{
    double number = reason->leg ? reason->leg : 1e-9 * (double)reason->lasted;
    int length = snprintf(text, size, stewart_faults[reason->fault], number);
    return length < 0 ? 0 : (size_t)length < size ? (size_t)length : size - 1;
}

void udp_reason(const stewart_reason *reason, const stewart_reason *before, char *text, size_t size)
{
    size_t used = put_reason(reason, text, size);
    if (!before->fault)
        return;
    used += (size_t)snprintf(text + used, size - used, " (before that, ");
    if (used < size)
        used += put_reason(before, text + used, size - used);
    if (used < size)
        snprintf(text + used, size - used, ")");
}

/* The name of a part, with its digest where the other end has the same name. */
static int put_part(const stewart_part *part, const stewart_part *other, char *text, size_t size)
{
    char digest[2 * STEWART_DIGEST + 1];
    if (strcmp(part->name, other->name) != 0)
        return snprintf(text, size, "%s", part->name);
    for (int i = 0; i < STEWART_DIGEST; i++)
        snprintf(digest + 2 * i, 3, "%02x", part->digest[i]);
    return snprintf(text, size, "%s with digest %s", part->name, digest);
}

void udp_differing(const stewart_identity *machine, const stewart_identity *controller, char text[UDP_DIFFERING])
{
    static const char *const names[STEWART_PARTS] = {"mechanism", "period", "sensor", "actuator"};
    unsigned differing = stewart_differing(machine, controller);
    char *at = text, *end = text + UDP_DIFFERING; /* enough for all parts, whose names have up to STEWART_NAME bytes */
    for (unsigned i = 0; i < STEWART_PARTS; i++) {
        const stewart_part *one = &machine->parts[i], *other = &controller->parts[i];
        if (!(differing >> i & 1u))
            continue;
        at += snprintf(at, (size_t)(end - at), "%sdifferent %s (machine: ", at == text ? "" : ", ", names[i]);
        at += put_part(one, other, at, (size_t)(end - at));
        at += snprintf(at, (size_t)(end - at), "; controller: ");
        at += put_part(other, one, at, (size_t)(end - at));
        at += snprintf(at, (size_t)(end - at), ")");
    }
    snprintf(at, (size_t)(end - at), ": export or start both ends from the same %s",
             differing == 1 ? "mechanism file" : "scenario");
}
