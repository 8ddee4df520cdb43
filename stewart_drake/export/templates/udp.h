/* POSIX functions of the two examples: monotonic clock, non-blocking socket, key. */

#pragma once

#include <netinet/in.h>
#include <stdint.h>

#include "protocol.h"

#define SECOND 1000000000u
#define UDP_LAST_PORT 65535
#define UDP_LONGEST 1e6 /* s, of a run */

/* Monotonic clock, ns. */
uint64_t udp_now(void);

/* Random bytes of the system; prints an error and returns 0 if there are none. */
int udp_draw(void *bytes, size_t size);

/* A socket at a port, 0 for any, of the loopback interface or, with a key, of all; -1 on an error,
   which is printed. */
int udp_open(uint16_t port, stewart_key key);

/* Whether the first argument is --help or -h; then prints the usage. */
int udp_help(int argc, char **argv, const char *usage);

/* A number of the command line, above 0 and up to `most`, a whole one unless `parts`. Prints an error and
   returns 0 for anything else. */
double udp_number(const char *name, const char *text, double most, int parts);

/* Wait for a datagram, at the longest until an instant of the own clock. */
void udp_wait(int socket, uint64_t until);

/* Whether there was a datagram, and its size, of up to STEWART_LONGEST + 1 bytes, which may be 0. */
int udp_get(int socket, uint8_t *data, size_t *size, struct sockaddr_in *from);

/* Whether the datagram was sent. */
int udp_put(int socket, const uint8_t *data, size_t size, const struct sockaddr_in *to);

int udp_same(const struct sockaddr_in *one, const struct sockaddr_in *other);

/* The key of a file, NULL for none. Prints an error and returns an empty key unless it has 16 to
   4096 bytes. */
stewart_key udp_key(const char *path);

/* See `stewart_nonce`. */
uint64_t udp_nonce(const stewart_offers *offers, uint64_t session, const struct sockaddr_in *from);

/* Whether Ctrl-C was pressed since this was called first. */
int udp_interrupted(void);

/* Print the number of refused datagrams by cause. */
void udp_tell(const unsigned *refused);

/* Why torques do not act, in words. */
void udp_reason(const stewart_reason *reason, const stewart_reason *before, char *text, size_t size);

/* What differs between a machine and a controller, what each has, and what to do, in one line. */
#define UDP_DIFFERING 768
void udp_differing(const stewart_identity *machine, const stewart_identity *controller, char text[UDP_DIFFERING]);
