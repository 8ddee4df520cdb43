/* State, parameters and an unknown delay: the filter of one hypothesis, and the search among them. */

#pragma once

#include "arrivals.h"
#include "filter.h"

#define STEWART_NEVER 1000000 /* s; the delay of torques that do not arrive */

enum {
    STEWART_GUESS = 11,        /* numbers of a hypothesis without its mean and root */
    STEWART_DELAY_NUMBERS = 16, /* numbers of the memory without its arrays */
    STEWART_MAX_SCHEDULE = 8,  /* torques that act in a period, at a rate of the delay within bounds */
};

/* Places of eta and eta_dot in xi = [x; theta; eta; eta_dot] (n). */
#define STEWART_ETA(n) ((n) - 2)
#define STEWART_RATE(n) ((n) - 1)

/* Assumptions about the state, the parameters theta (p) and the delay. */
typedef struct {
    stewart_filter filter;           /* of state and theta; `timing_std` is that of the first torques */
    const real *prior, *std;         /* (p) mean and standard deviation of theta */
    real period;                     /* dt, s */
    real believed, delay_std;        /* s, mean and standard deviation of the delay's prior */
    real longest;                    /* s */
    real timing_std;                 /* s, least standard deviation of the timing of torques */
    real walk;                       /* s per root s, change of the delay */
    real rate_std, rate_walk;        /* s/s, and s/s per root s; 0 for a delay without a rate */
    int quiet;                       /* whether nothing is fed back before the delay is found */
} stewart_delay;

/* A hypothesis of the delay with its filter, in one flat vector. */
typedef struct {
    real low, high;      /* s, between which eta is */
    real log_likelihood; /* of the last measurement */
    real fits;           /* whether the last measurement was not an outlier */
    real outliers;       /* consecutive ones, also those that a torque's timing or a jump explains */
    real timing;         /* s^2, variance of the timing of single torques */
    real torques;        /* number of torques in that estimate */
    real heard;          /* number of measurements since an own torque has arrived */
    real weight;         /* log of the probability, relative to the best hypothesis */
    real squares;        /* sum of nu' S^-1 nu of the measurements that were used */
    real values;         /* number of values in them */
    real numbers[];      /* mean of xi = [x; theta; eta; eta_dot] (n), then the lower triangle of the
                            root of its covariance, by rows; its last two rows are 0, and eta is
                            NEVER, where nothing has arrived */
} stewart_guess;

int stewart_guess_size(int p);

/* The root of its covariance, lower triangular (n, n), and back; the standard deviation of eta. */
void stewart_guess_root(const stewart_guess *guess, int n, real *L);
void stewart_guess_keep_root(int n, const real *L, stewart_guess *guess);
real stewart_guess_std(const stewart_guess *guess, int n);

/* One period as a function of xi. */
typedef struct {
    const stewart_delay *delay;
    stewart_arrivals view; /* at its beginning; eta and rate are replaced by those of xi */
    int flights, newest;   /* see stewart_torque_schedule */
    const real *in_flight; /* (flights, 6) */
} stewart_period;

int stewart_period_scratch(int p, int flights); /* of each of these */

/* Compute the state at the end. Returns 0 for too many torques. */
int stewart_period_end(const stewart_period *period, const real *xi, real *state,
                       stewart_scratch scratch);

/* Compute the state at the end, and H (12, n) = d[state]/d[xi]; `fourth_order`: see stewart_transitions.
   Returns 0 where they do not exist. */
int stewart_period_at(const stewart_period *period, const real *xi, int fourth_order, real *state,
                      real *H, stewart_scratch scratch);

/* Compute rows K (k, 12): changes of the state at the end if a single torque is early or late by one
   standard deviation. The first `others` rows are of torques before the controller's own. The rest are of
   own torques, with the standard deviation `std` in s. K'K is the covariance. Returns k, at most
   STEWART_MAX_SCHEDULE, or -1 for too many torques. */
int stewart_period_late(const stewart_period *period, const real *xi, const real *state, real std,
                        real *K, int *others, stewart_scratch scratch);

/* Advance a hypothesis by a period, and correct it by a measurement y (m) at its end, if not NULL. */
void stewart_delay_advance(const stewart_period *period, const stewart_guess *guess, const real *y,
                           stewart_guess *after, stewart_scratch scratch);

int stewart_delay_advance_scratch(int p, int m, int flights);

/* The belief, in one flat vector. */
typedef struct {
    real eta, rate, sent;        /* the delay to use, s and s/s, see stewart_arrivals */
    real known;                  /* whether there has been a measurement */
    real searching;              /* whether there are several hypotheses */
    real cells;                  /* number of hypotheses in which a torque has arrived */
    real best;                   /* place of the most probable one */
    real rejected;               /* whether the last measurement was an outlier */
    real found;                  /* whether the delay has just been found, or is another than before */
    real fresh;                  /* whether that was at this sample, and took so long that planning waits
                                    for the next one */
    real silent;                 /* whether nothing is fed back until the delay is found */
    real feeds_back;             /* whether the estimate is good enough for feedback */
    real caution;                /* factor on the weight of torques */
    real settled;                /* whether the delay is known */
    real mean, std;              /* s, of the delay; NaN before the first measurement */
    real numbers[];              /* torques that act until an own one arrives (flights - 1 or 1, 6), the
                                    last two measurements (2, m), then hypotheses: first the master,
                                    or the only one */
} stewart_delay_memory;

/* Numbers of the memory for p parameters, m values and a number of torques in flight at a sample. */
int stewart_delay_size(int p, int m, int flights);

int stewart_delay_scratch(int p, int m, int flights);

/* The hypothesis at a place: 0 is the master or the only one, 1 to `cells` are cells. */
stewart_guess *stewart_delay_guess(int p, int m, int flights, stewart_delay_memory *memory,
                                   int place);

void stewart_delay_start(const stewart_delay *delay, int flights, stewart_delay_memory *memory);

/* Advance by a period, and correct by a measurement y (m) at its end, if not NULL. `in_flight` (flights,
   6) are the torques sent before this sample; `near` (12) is the expected state. */
void stewart_delay_observe(const stewart_delay *delay, int flights, const real *in_flight,
                           const real *y, const real *near, stewart_delay_memory *memory,
                           stewart_scratch scratch);
