/* The link from the controller to the motors, as a machine of events over one clock: begin, take,
   next_change, change. It is either a wire, on which a command acts when it arrives, or a play-out
   buffer, in which commands wait for their times.

   Times are numbers of any unit, double so that nanoseconds are exact for a hundred days. */

#pragma once

#include "real.h"

/* Order of the events of one instant: the controller's sample is taken and its command sent; then a
   command acts, of several that are there the newest; then the plant goes on. */
typedef struct {
    int size;        /* numbers of a command */
    int kept;        /* commands that can wait */
    int history;     /* commands that have acted and are remembered, >= 1 */
    int wire;        /* whether it is a wire */
    int holds;       /* whether a dry buffer holds the last command, or puts out zero */
    double period;   /* of a buffered command */
    double together; /* instants so close to each other are one */
    real limit;      /* of each number of a command that acts; infinite for none */
} stewart_link;

/* Places in the memory, which then has the commands that have acted, the newest first (history,
   1 + size), each after its time, and those that wait (kept, 3 + size), each after the time at which
   it is to act, its sequence and its arrival. */
enum {
    STEWART_LINK_LAST,     /* time of the last change */
    STEWART_LINK_NEWEST,   /* sequence of the command that acts on a wire */
    STEWART_LINK_COUNTS,   /* whether a period without a command counts as dry */
    STEWART_LINK_FED,      /* whether what acts was taken, not there from the beginning */
    STEWART_LINK_PLAYED,   /* changes to a command that was taken */
    STEWART_LINK_DRY,      /* periods without one */
    STEWART_LINK_TAKEN,    /* commands or plans that were taken */
    STEWART_LINK_WAITING,  /* number of commands that wait */
    STEWART_LINK_ACTED,    /* number of commands that have acted, `history` at the most */
    STEWART_LINK_COMMANDS, /* here the commands begin */
};

enum { STEWART_LINK_TAKES, STEWART_LINK_FULL, STEWART_LINK_LATE };

/* Numbers of the memory. */
int stewart_link_memory(const stewart_link *link);

/* Nothing waits, nothing acts but zero. */
void stewart_link_start(const stewart_link *link, double *memory);

/* What acts (size) before the first change, and has done so since `time`. */
void stewart_link_assume(const stewart_link *link, double *memory, double time,
                         const double *command);

/* Commands (number, size) are under way that act at `first`, a period later and so on. */
void stewart_link_begin(const stewart_link *link, double *memory, double first, int number,
                        const double *commands);

/* A plan (number, size) whose first command shall act at `first`, and the others a period later each.
   On a wire only the first counts. `sequence` > 0 orders plans by age. It is there from its
   `arrival` on, infinite for a lost one; commands that are to act before that, or before `now`,
   never do. Returns why it is of no use, or STEWART_LINK_TAKES. */
int stewart_link_take(const stewart_link *link, double *memory, double now, double sequence,
                      double arrival, double first, int number, const double *commands);

/* When `change` is to be called next; infinite for never. */
double stewart_link_next(const stewart_link *link, const double *memory);

/* What acts from an instant on. */
void stewart_link_change(const stewart_link *link, double *memory, double time);

/* Forget what waits; the last command, or zero, until another is taken. */
void stewart_link_safe(const stewart_link *link, double *memory, double time, int holds);

/* The command (size) that acts. */
const double *stewart_link_current(const double *memory);
