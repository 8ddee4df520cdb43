/* Probable torques in flight over a network, from sent packets and the machine's reports. */

#pragma once

#include "matrix.h"

/* Packet k has the torques of `repeats` earlier samples, unchanged, then T_k and the plan of
   those that follow: rows = repeats + torques, of 6 numbers each. */
typedef struct {
    int torques; /* N >= 1 */
    int repeats; /* r */
    int num_packets; /* packets in memory, >= 1 */
    int report_periods; /* periods that a report covers */
    int holds;   /* whether a dry buffer holds the last torque, or puts out zero */
    int burst;   /* packets that are lost together, >= 1 */
    real loss;   /* probability that a packet is lost */
    const real *in_time;    /* (rows) probability that a packet which is not lost has arrived by the
                               time of the row */
    const real *arrived_by; /* (num_packets) the same after 0, 1, ... periods */
} stewart_packets;

/* The machine's report, which came with a measurement. */
typedef struct {
    int packets;         /* in the report, the newest first */
    const real *arrived; /* whether the one sent i + 1 samples before has arrived, 1 or 0 */
    int periods;         /* in the report, the newest first */
    const real *acted;   /* (periods, 6) torque that acted i + 1 periods before, N m; a row that is not
                            finite changes nothing */
    int age;             /* periods since that sample; negative: no report */
} stewart_report;

/* Memory: periods since the last report, num_packets where there was none; whether each packet is known to
   have arrived, 1 or 0 (num_packets); the packets, the newest last (num_packets, rows, 6), NaN before the
   first ones. */
int stewart_packets_memory(const stewart_packets *packets);

int stewart_packets_scratch(const stewart_packets *packets);

/* Set the memory before the first sample. */
void stewart_packets_start(const stewart_packets *packets, real *memory);

/* Update the memory and the torques in flight (number, 6), the oldest first, by a report or NULL. T_k
   acts from (k + steps) dt on, and a part of a period later. */
void stewart_packets_update(const stewart_packets *packets, real *memory,
                            const stewart_report *report, int steps, int number, real *in_flight,
                            stewart_scratch scratch);

/* Add the packet of a plan (torques, 6); `in_flight` (number, 6) are the torques before it. */
void stewart_packets_send(const stewart_packets *packets, real *memory, const real *plan, int number,
                          const real *in_flight);

/* Rows (repeats + torques, 6) of the packet that was sent last. */
const real *stewart_newest_packet(const stewart_packets *packets, const real *memory);

/* Probabilities (n + 1) of the sources of T_{k-1-d}: chances[i], i < n, that the packet sent i + 1
   samples ago is in time and no newer one is; chances[n] that no packet is. Returns n <= known.
   `chances` has room for known + 1 numbers.

   known: number of packets in memory that have been sent.
   arrived: (known) whether each is known to have arrived, the newest last.
   since: periods since the last report.
   last: number of torques of the query, > d. */
int stewart_packet_chances(const stewart_packets *packets, int known, const real *arrived, int since,
                           int last, int d, real *chances, stewart_scratch scratch);
