/* The link from controller to motors, as an event-driven state machine: call `start` once, `take` for
   each plan, `change` at every time that `next` returns. It is either a wire, on which a command acts
   when it arrives, or a play-out buffer, in which commands wait for their times. A buffer is dry in a period
   for which it has no command.

   Events at the same time have this order: the controller samples and sends its command; then the
   newest of the due commands acts; then the plant moves on.

   Times have any unit. They are doubles, exact for nanoseconds over a hundred days. */

#pragma once

#include "real.h"

typedef struct {
    int size;              /* numbers of a command */
    int max_waiting;       /* greatest number of waiting commands */
    int history;           /* number of past commands in memory, >= 1 */
    int is_wire;           /* 1: a wire, 0: a buffer */
    int hold_when_dry;     /* a dry buffer holds the last command (1), or puts out zero (0) */
    double period;         /* from each command of a plan to the next */
    double time_tolerance; /* times closer than this are equal */
    real limit;            /* greatest absolute value of each number of a command; may be infinite */
} stewart_link;

/* Memory, in this order:

       numbers                 content
       STEWART_LINK_COMMANDS   the values below
       history (1 + size)      past commands, the newest first: time, command
       max_waiting (3 + size)  waiting commands: time to act, sequence, arrival, command */
enum {
    STEWART_LINK_LAST,     /* time of the last change */
    STEWART_LINK_NEWEST,   /* sequence of the last command that acted, -infinity before the first */
    STEWART_LINK_COUNTS,   /* 1 after the first change: from then on each dry period is a change */
    STEWART_LINK_FED,      /* 1 if the acting command came from `take` */
    STEWART_LINK_PLAYED,   /* number of commands from `take` that have acted */
    STEWART_LINK_DRY,      /* number of periods of a buffer without a command */
    STEWART_LINK_SUPPLIED, /* end of the period of the last command */
    STEWART_LINK_OFFERED,  /* number of plans that found room, late ones too */
    STEWART_LINK_WAITING,  /* number of waiting commands */
    STEWART_LINK_ACTED,    /* number of past commands in memory, at most `history` */
    STEWART_LINK_COMMANDS, /* first number of the past commands */
};

/* Results of `take`. */
enum { STEWART_LINK_ACCEPTED, STEWART_LINK_NO_ROOM, STEWART_LINK_TOO_LATE };

/* Number of doubles in the memory. */
int stewart_link_memory(const stewart_link *link);

/* Empty the memory; zero acts. */
void stewart_link_start(const stewart_link *link, double *memory);

/* Set the command (size) that has acted since `time`; fills the history. */
void stewart_link_assume(const stewart_link *link, double *memory, double time,
                         const double *command);

/* Queue commands (number, size) for `first`, a period later, and so on, as if under way already. */
void stewart_link_preload(const stewart_link *link, double *memory, double first, int number,
                          const double *commands);

/* Take a plan (number, size): its first command is to act at `first`, each other one a period later. A
   wire takes only the first. `sequence` > 0 orders plans by age. The plan arrives at `arrival`
   (infinite: lost). Commands due before that, or before `now`, are dropped. Returns
   STEWART_LINK_ACCEPTED, or the reason of the refusal. */
int stewart_link_take(const stewart_link *link, double *memory, double now, double sequence,
                      double arrival, double first, int number, const double *commands);

/* Time of the next call of `change`; infinite for none. */
double stewart_link_next(const stewart_link *link, const double *memory);

/* Let the newest command act that is due at `time` and has arrived, and drop the others that are due.
   A buffer without one goes dry: it holds the last command, or puts out zero. */
void stewart_link_change(const stewart_link *link, double *memory, double time);

/* Hold the last command (`holds`) or put out zero until another command acts. Drop the waiting commands
   unless `keeps`. */
void stewart_link_reset(const stewart_link *link, double *memory, double time, int holds, int keeps);

/* Return the acting command (size). */
const double *stewart_link_current(const double *memory);
