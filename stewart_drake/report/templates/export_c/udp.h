/* What the two examples need of POSIX: a clock that nobody sets, a socket that never blocks, a key. */

#ifndef STEWART_UDP_H
#define STEWART_UDP_H

#include <netinet/in.h>
#include <stdint.h>

#include "protocol.h"

#define SECOND 1000000000u

/* ns of the own clock. */
uint64_t udp_now(void);

/* A random number that is not 0. */
uint64_t udp_draw(void);

/* A socket at a port, 0 for any, of the loopback interface or, with a key, of all; -1 on an error,
   which is told. */
int udp_open(uint16_t port, stewart_key key);

/* Wait for a datagram, at the longest until an instant of the own clock. */
void udp_wait(int socket, uint64_t until);

/* The next datagram, of up to STEWART_LONGEST + 1 bytes; 0 for none. */
size_t udp_get(int socket, uint8_t *data, struct sockaddr_in *from);

/* Whether it went out. */
int udp_put(int socket, const uint8_t *data, size_t size, const struct sockaddr_in *to);

int udp_same(const struct sockaddr_in *one, const struct sockaddr_in *other);

/* The key of a file, NULL for none; with no bytes if it is shorter than 16, which is told. */
stewart_key udp_key(const char *path);

/* Whether Ctrl-C was pressed since this was called first. */
int udp_interrupted(void);

/* Datagrams that were not acted upon, by cause. */
void udp_tell(const unsigned *refused);

#endif
