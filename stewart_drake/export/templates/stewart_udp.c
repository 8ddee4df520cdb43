/* The controller behind a socket, as an example: it drives a machine that speaks docs/protocol.md.

       ./stewart_udp ADDRESS PORT [seconds=S] [key=FILE] [log=FILE] [arm]

   It asks for a session, finds the machine's clock, chooses when to begin, and then steps the
   controller once a period of the machine. Without a key it talks to this computer only; a machine that
   does not say that it is a simulation is driven with `arm` only. The log has a row per sample; `age` is
   the number of periods before the sample at which the state was measured. */

#define _POSIX_C_SOURCE 200809L

#include <arpa/inet.h>
#include <math.h>
#include <stdio.h>
#include <string.h>

#include "stewart_config.h"
#include "stewart_example.h"
#include "udp.h"

#define TRIPS 64
#define ENOUGH 10 /* round trips for the offset of the clock */
#define REPEATS 7 /* earlier torques that a datagram repeats, against losses */
#define PLANNED 8 /* planned torques of a datagram, against later losses */

/* Round trips, and the offset of the machine's clock by each; the shortest one is used. */
typedef struct {
    double trip[TRIPS], there[TRIPS], rate;
    unsigned number;
} other_clock;

typedef struct {
    int socket;
    struct sockaddr_in machine;
    stewart_key key;
    stewart_session session;
    int offered, busy, other_version; /* what a machine has answered */
    stewart_identity identity;        /* of the machine */
    other_clock clock;
    stewart_measured last; /* the newest by `sampled` */
    uint64_t begin, used;  /* of the machine's clock; that of the measurement used last, plus 1 */
    uint32_t flags;
    unsigned refused[STEWART_REFUSALS];
    real memory[STEWART_MEMORY], ahead[STEWART_MEMORY], scratch[STEWART_SCRATCH];
    real said[REPEATS + 1 + PLANNED][STEWART_MOTORS]; /* the last torques, and those that would follow */
    unsigned samples, missing, missed;
    double seconds;
    FILE *log;
} controller;

static void clock_note(other_clock *c, const stewart_head *h, double rate, uint64_t now)
{
    if (h->acknowledged == 0)
        return;
    unsigned i = c->number++ % TRIPS;
    c->rate = rate;
    c->trip[i] = (double)(now - h->echo) - (double)h->held / rate;
    c->there[i] = (double)h->time + rate * (c->trip[i] > 0 ? c->trip[i] : 0) / 2 - rate * (double)now;
}

static unsigned shortest(const other_clock *c)
{
    unsigned best = 0;
    for (unsigned i = 1; i < c->number && i < TRIPS; i++)
        best = c->trip[i] < c->trip[best] ? i : best;
    return best;
}

/* The own clock at a time of the machine's. */
static uint64_t own_time(const other_clock *c, uint64_t machine)
{
    return (uint64_t)(((double)machine - c->there[shortest(c)]) / c->rate);
}

static double machine_time(const other_clock *c, uint64_t own)
{
    return c->rate * (double)own + c->there[shortest(c)];
}

static void receive(controller *c)
{
    uint8_t data[STEWART_LONGEST + 1];
    struct sockaddr_in from;
    stewart_measured m;
    size_t size;
    while (udp_get(c->socket, data, &size, &from)) {
        uint64_t now = udp_now();
        int cause = stewart_read_measured(data, size, c->key, &m);
        if (cause == STEWART_VERSION && udp_same(&from, &c->machine))
            c->other_version = data[4];
        if (!cause && !udp_same(&from, &c->machine))
            cause = STEWART_FOREIGN;
        if (!cause)
            cause = stewart_note(&c->session, &m.head, now);
        c->refused[cause]++;
        if (cause)
            continue;
        if (m.kind == STEWART_OFFER) {
            c->offered = 1;
            c->busy = (m.head.flags & STEWART_BUSY) != 0;
            c->identity = m.identity;
            if (!c->busy && c->session.nonce == 0)
                c->session.nonce = m.head.nonce;
        }
        clock_note(&c->clock, &m.head, m.rate, now);
        if (m.sampled >= c->last.sampled)
            c->last = m;
    }
}

/* Send torques; the first acts at `playout`. */
static void say(controller *c, uint32_t flags, uint64_t sampled, uint64_t playout,
                real torques[][STEWART_MOTORS], unsigned rows)
{
    uint8_t data[STEWART_LONGEST];
    stewart_plan plan;
    memset(&plan, 0, sizeof plan);
    plan.head = stewart_next(&c->session, udp_now(), c->flags | flags);
    plan.sampled = sampled;
    plan.playout = playout;
    plan.begin = c->begin;
    plan.content = c->session.nonce ? STEWART_TORQUES : STEWART_REQUEST;
    plan.identity = stewart_own_identity;
    plan.rows = (uint8_t)rows;
    for (unsigned row = 0; row < rows; row++)
        for (int i = 0; i < STEWART_MOTORS; i++)
            plan.torques[row][i] = (double)torques[row][i];
    udp_put(c->socket, data, stewart_write_plan(&plan, c->key, data), &c->machine);
}

/* Take the measurement of an instant, NaN without any; return its age in periods. */
static int take(controller *c, uint64_t sampled, real *measurement)
{
    int fresh = c->last.kind == STEWART_STATE && c->last.sampled >= c->used &&
                c->last.sampled >= c->begin && c->last.sampled <= sampled;
    uint64_t age = fresh ? (sampled - c->last.sampled + c->last.period / 2) / c->last.period : 0;
    fresh &= age <= (uint64_t)stewart_configuration.longest_wait;
    for (int i = 0; i < STEWART_STATES; i++)
        measurement[i] = fresh ? (real)c->last.state[i] : (real)NAN;
    c->used = fresh ? c->last.sampled + 1 : c->used;
    c->missing += !fresh;
    return fresh ? (int)age : 0;
}

static void note_head(const controller *c)
{
    static const char *const names[] = {"roll", "pitch", "yaw", "x", "y", "z"};
    fprintf(c->log, "time[s]");
    for (int i = 0; i < 6; i++)
        fprintf(c->log, ",%s[%s]", names[i], i < 3 ? "rad" : "m");
    for (int i = 0; i < 6; i++)
        fprintf(c->log, ",%s_dot[%s/s]", names[i], i < 3 ? "rad" : "m");
    for (int i = 0; i < STEWART_MOTORS; i++)
        fprintf(c->log, ",torque_%d[N m]", i + 1);
    fprintf(c->log, ",age[periods]\n");
}

static void note(const controller *c, double t, const real *measurement, const real *torque,
                 int age)
{
    fprintf(c->log, "%.9g", t);
    for (int i = 0; i < STEWART_STATES; i++)
        fprintf(c->log, ",%.17g", (double)measurement[i]);
    for (int i = 0; i < STEWART_MOTORS; i++)
        fprintf(c->log, ",%.17g", (double)torque[i]);
    fprintf(c->log, ",%d\n", age);
}

/* From a sample to its torque, ns. */
static uint64_t eta(const controller *c)
{
    const stewart_law *law = &stewart_configuration;
    return (uint64_t)((law->steps + (double)law->fraction) * (double)c->last.period + 0.5);
}

/* Correct the memory by the reported torques, which differ from the sent ones if these came late. */
static void correct(controller *c, unsigned k)
{
    real acted[STEWART_HISTORY][STEWART_MOTORS];
    double period = (double)c->last.period;
    if (c->last.history == 0)
        return;
    for (int row = 0; row < c->last.history; row++)
        for (int i = 0; i < STEWART_MOTORS; i++)
            acted[row][i] = (real)c->last.acted[row][i];
    double since = (double)(c->begin + eta(c)) - (double)c->last.acted_from;
    stewart_note_acted(&stewart_configuration, c->memory, (int)k + (int)lround(since / period),
                  c->last.history, acted[0]);
}

/* The law at sample k, its torque within the machine's limit. */
static void compute(controller *c, real *memory, unsigned k, const real *measurement, int age,
                    real *torque)
{
    const stewart_law *law = &stewart_configuration;
    double now = k * (double)law->period;
    real limit = (real)fmin(c->last.torque_limit, (double)law->machine.torque_limit);
    stewart_sample sample = {.measurement = measurement, .age = age, .reference = stewart_look_ahead};
    sample.goal = stewart_look_back;
    sample.context = &now;
    sample.weights[0] = stewart_weights[0];
    sample.weights[1] = stewart_weights[1];
    stewart_step(law, memory, c->scratch, &sample, torque);
    for (int i = 0; i < STEWART_MOTORS; i++)
        torque[i] = (real)fmax(-limit, fmin(limit, torque[i]));
    stewart_note_acted(law, memory, 1, 1, torque);
}

/* Plan the torques that follow without further measurements. */
static void plan(controller *c, unsigned k)
{
    real nothing[STEWART_STATES];
    for (int i = 0; i < STEWART_STATES; i++)
        nothing[i] = (real)NAN;
    memcpy(c->ahead, c->memory, sizeof c->ahead);
    for (unsigned i = 1; i <= PLANNED; i++)
        compute(c, c->ahead, k + i, nothing, 0, c->said[REPEATS + i]);
}

static void step(controller *c, unsigned k)
{
    uint64_t period = c->last.period, sampled = c->begin + k * period;
    real measurement[STEWART_STATES], *torque = c->said[REPEATS];
    /* Repetitions and plans need a buffer; only torques of future periods are repeated. */
    int waits = !(c->last.head.flags & STEWART_WIRE);
    unsigned steps = (unsigned)stewart_configuration.steps, repeats = steps < k ? steps : k;
    repeats = !waits ? 0 : repeats < REPEATS ? repeats : REPEATS;
    int age = take(c, sampled, measurement);
    memmove(c->said[0], c->said[1], REPEATS * sizeof c->said[0]);
    if (waits)
        correct(c, k);
    compute(c, c->memory, k, measurement, age, torque);
    if (waits)
        plan(c, k);
    say(c, 0, sampled, sampled + eta(c) - repeats * period, c->said + REPEATS - repeats,
        repeats + 1 + (waits ? PLANNED : 0));
    if (c->log)
        note(c, k * (double)stewart_configuration.period, measurement, torque, age);
    c->samples++;
    c->missed += udp_now() > own_time(&c->clock, sampled + period);
}

/* Return why a machine is not driven, or NULL. */
static const char *objection(const controller *c)
{
    static char text[512], own[160], other[160];
    if (c->other_version) {
        snprintf(text, sizeof text, "the machine speaks protocol version %d; expected %d",
                 c->other_version, STEWART_PROTOCOL);
        return text;
    }
    if (!c->offered)
        return NULL;
    if (stewart_differing(&stewart_own_identity, &c->identity)) {
        udp_differing(&stewart_own_identity, &c->identity, own, sizeof own);
        udp_differing(&c->identity, &stewart_own_identity, other, sizeof other);
        snprintf(text, sizeof text, "the machine has %s; this controller is designed for %s", other, own);
        return text;
    }
    if (!(c->last.head.flags & STEWART_SIMULATION) && !(c->flags & STEWART_ARMED))
        return "this is a real machine: say `arm` to drive it";
    return NULL;
}

static const char *in_use(const controller *c)
{
    static char text[160];
    char address[INET_ADDRSTRLEN];
    inet_ntop(AF_INET, &c->machine.sin_addr, address, sizeof address);
    snprintf(text, sizeof text,
             "machine at %s:%u is in use by another controller (retry %g s after it stops)", address,
             ntohs(c->machine.sin_port), 1e-9 * (double)c->last.watchdog);
    return text;
}

/* Return why the machine does not continue, or NULL. */
static const char *fault(const controller *c)
{
    static char text[200];
    const stewart_measured *m = &c->last;
    size_t used = 0;
    if (!(m->head.flags & STEWART_LEFT) && m->reason.fault != STEWART_ENDED)
        return NULL;
    if (m->head.flags & STEWART_LEFT)
        used = (size_t)snprintf(text, sizeof text, "left workspace: ");
    udp_reason(&m->reason, &m->before, text + used, sizeof text - used);
    return text;
}

/* Agree on a session and a begin; return why not, or NULL. */
static const char *greet(controller *c)
{
    uint64_t patience = udp_now() + 10ull * SECOND;
    while (c->last.begin == STEWART_NEVER || c->begin == STEWART_NEVER || c->last.period == 0) {
        if (udp_interrupted() || udp_now() > patience)
            return c->busy ? in_use(c) : "the machine does not answer";
        say(c, 0, 0, 0, NULL, 0);
        uint64_t next = udp_now() + (c->last.period ? c->last.period : SECOND / 10);
        while (udp_now() < next) {
            udp_wait(c->socket, next);
            receive(c);
        }
        const char *problem = objection(c);
        if (problem)
            return problem;
        if (c->session.nonce == 0)
            continue;
        if (c->begin == STEWART_NEVER && c->clock.number >= ENOUGH) {
            double trip = c->clock.trip[shortest(&c->clock)], ahead = 5 * (double)c->last.period;
            double wanted = machine_time(&c->clock, udp_now()) + ahead + 2 * c->clock.rate * trip;
            c->begin = ((uint64_t)wanted / c->last.period + 1) * c->last.period;
        }
    }
    c->begin = c->last.begin; /* as the machine says */
    return NULL;
}

/* Longest time to wait for the measurement of a sample, own ns; 0: late ones are used later. */
static uint64_t longest_patience(const controller *c)
{
    if (stewart_configuration.longest_wait)
        return 0;
    return c->last.period / (eta(c) > c->last.period ? 2 : 4);
}

/* Print a warning if the link is too slow for this controller. */
static void warn_of_link(const controller *c)
{
    double trip = c->clock.trip[shortest(&c->clock)];
    uint64_t patience = longest_patience(c);
    if (!(c->last.head.flags & STEWART_WIRE) && trip > (double)eta(c))
        printf("warning: a round trip takes %.3g ms, but torques are to act %.3g ms after their sample: they "
               "are late; export with a longer delay (delay.steps)\n", 1e-6 * trip, 1e-6 * (double)eta(c));
    if (patience && trip / 2 > (double)patience)
        printf("warning: measurements take about %.3g ms, but are waited for only %.3g ms: they are missing; "
               "export with their delay (sensor.delay, s)\n", 5e-7 * trip, 1e-6 * (double)patience);
}

/* Run all samples; return why the run ended early, or NULL. */
static const char *drive(controller *c)
{
    unsigned number = (unsigned)(c->seconds / (double)stewart_configuration.period + 0.5);
    int waits = stewart_configuration.longest_wait == 0;
    uint64_t longest = longest_patience(c);
    for (uint64_t t = own_time(&c->clock, c->begin); udp_now() + SECOND / 20 < t;) {
        say(c, 0, 0, 0, NULL, 0); /* still here */
        udp_wait(c->socket, udp_now() + SECOND / 20);
        receive(c);
    }
    for (unsigned k = 0; k < number; k++) {
        uint64_t sampled = c->begin + k * c->last.period;
        uint64_t patience = own_time(&c->clock, sampled + longest);
        for (receive(c); udp_now() < patience && !(waits && c->last.sampled >= sampled); receive(c))
            udp_wait(c->socket, patience);
        if (udp_interrupted())
            return "interrupted";
        const char *problem = fault(c);
        if (problem)
            return problem;
        if (udp_now() > c->session.heard + 2 * c->last.watchdog)
            return "the machine has fallen silent";
        step(c, k);
    }
    return NULL;
}

/* Read the command line; prints an error and returns 0 if it is wrong. */
static int understood(controller *c, int argc, char **argv)
{
    int usable = argc > 2 && inet_pton(AF_INET, argv[1], &c->machine.sin_addr) == 1;
    double port = usable ? udp_number("PORT", argv[2], UDP_LAST_PORT, 0) : 0;
    c->machine.sin_family = AF_INET;
    c->machine.sin_port = htons((uint16_t)port);
    c->seconds = stewart_duration;
    if (usable && port == 0)
        return 0;
    for (int i = 3; usable && i < argc; i++) {
        const char *text = argv[i];
        if (strncmp(text, "seconds=", 8) == 0) {
            if (!(c->seconds = udp_number("seconds", text + 8, UDP_LONGEST, 1)))
                return 0;
        } else if (strncmp(text, "key=", 4) == 0) {
            if (!(c->key = udp_key(text + 4)).size)
                return 0;
        } else if (strncmp(text, "log=", 4) == 0) {
            if (!(c->log = fopen(text + 4, "w"))) {
                perror(text);
                return 0;
            }
            note_head(c);
        } else if (strcmp(text, "arm") == 0) {
            c->flags = STEWART_ARMED;
        } else {
            usable = 0;
        }
    }
    if (usable && (c->key.size || ntohl(c->machine.sin_addr.s_addr) >> 24 == 127))
        return 1;
    fprintf(stderr, "expected: stewart_udp ADDRESS PORT [seconds=S] [key=FILE] [log=FILE] [arm], "
                    "the address in numbers, beyond 127.0.0.1 with a key\n");
    return 0;
}

int main(int argc, char **argv)
{
    static controller c;
    if (!understood(&c, argc, argv))
        return 2;
    udp_interrupted();
    c.socket = udp_open(0, c.key);
    if (!udp_draw(&c.session.number, sizeof c.session.number))
        return 2;
    c.session.number += c.session.number == 0;
    c.begin = c.last.begin = STEWART_NEVER;
    stewart_start(&stewart_configuration, c.memory, stewart_queue_rows, stewart_queue);
    const char *problem = c.socket < 0 ? "no socket" : greet(&c);
    if (!problem) {
        printf("begins at %.3f s of the machine, round trip %.2f ms\n", 1e-9 * (double)c.begin,
               1e-6 * c.clock.trip[shortest(&c.clock)]);
        warn_of_link(&c);
        fflush(stdout);
        problem = drive(&c);
    }
    for (int i = 0; i < 3 && c.session.nonce; i++)
        say(&c, STEWART_STOP, 0, 0, NULL, 0);
    printf("%s after %u samples, %u of them without a measurement, %u late\n",
           problem ? problem : "completed", c.samples, c.missing, c.missed);
    udp_tell(c.refused);
    if (c.log)
        fclose(c.log);
    return problem != NULL;
}
