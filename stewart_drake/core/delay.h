/* Estimation of state, parameters and an unknown delay: the filter of one hypothesis of the delay, and the
   search among hypotheses. */

#pragma once

#include "arrivals.h"
#include "filter.h"
#include "observer.h"

#define STEWART_NO_ARRIVAL 1000000 /* s; the delay of torques that do not arrive */

enum {
    STEWART_HYPOTHESIS = 11,    /* numbers of a hypothesis without its mean and root */
    STEWART_DELAY_NUMBERS = 16, /* numbers of the memory without its arrays */
};

/* Places of eta and eta_dot in xi = [x; theta; eta; eta_dot] (n). */
#define STEWART_ETA(n) ((n) - 2)
#define STEWART_RATE(n) ((n) - 1)

/* Assumptions about the state, the parameters theta (p) and the delay. */
typedef struct {
    stewart_filter filter;           /* of state and theta; its `timing_std` is the initial one */
    const real *prior, *std;         /* (p) mean and standard deviation of theta */
    real period;                     /* dt, s */
    real delay_mean, delay_std;      /* s, prior of the delay */
    real longest;                    /* s, largest delay */
    real timing_std;                 /* s, least standard deviation of the timing of torques */
    real walk;                       /* s per root s, change of the delay */
    real rate_std, rate_walk;        /* s/s, and s/s per root s; 0 for a delay without a rate */
    int open_loop_start;             /* whether nothing is fed back before the delay is found */
} stewart_delay;

/* A hypothesis of the delay with its filter, in one flat vector. */
typedef struct {
    real low, high;      /* s, bounds of eta */
    real log_likelihood; /* of the last measurement */
    real fits;           /* whether the last measurement was not an outlier */
    real outliers;       /* consecutive ones, also those that a torque's timing or a jump explains */
    real timing;         /* s^2, variance of the timing of single torques */
    real torques;        /* number of torques in that estimate */
    real measurements;   /* number of measurements since an own torque has arrived */
    real weight;         /* log of the probability, relative to the best hypothesis */
    real chi2;           /* sum of nu' S^-1 nu of the measurements that were used */
    real chi2_values;    /* number of values in them */
    real numbers[];      /* mean of xi = [x; theta; eta; eta_dot] (n), then the lower triangle of the
                            root of its covariance, by rows; its last two rows are 0, and eta is
                            STEWART_NO_ARRIVAL, where no own torque has arrived */
} stewart_hypothesis;

int stewart_hypothesis_size(int p);

/* Unpack and pack the lower triangular root (n, n) of the covariance; return the standard deviation of a row,
   and that of eta. */
void stewart_unpack_root(int n, const real *packed, real *L);
real stewart_packed_std(int row, const real *packed);
void stewart_hypothesis_set_root(int n, const real *L, stewart_hypothesis *hypothesis);
real stewart_hypothesis_std(const stewart_hypothesis *hypothesis, int n);

/* One period as a function of xi. */
typedef struct {
    const stewart_delay *delay;
    stewart_arrivals view;     /* at its beginning; eta and rate are replaced by those of xi */
    int num_in_flight, newest; /* see stewart_torque_schedule */
    const real *in_flight;     /* (num_in_flight, 6) */
} stewart_period;

int stewart_period_scratch(int p, int num_in_flight); /* of each function of a period */

/* Compute the state at the end. Returns 0 for too many torques. */
int stewart_period_end(const stewart_period *period, const real *xi, real *state,
                       stewart_scratch scratch);

/* Compute the state at the end, and H (12, n) = d[state]/d[xi]; `fourth_order`: see stewart_transitions.
   Returns 0 where they do not exist. */
int stewart_period_at(const stewart_period *period, const real *xi, int fourth_order, real *state,
                      real *H, stewart_scratch scratch);

/* Add to `cost` the square of the error of a measurement y (m) at the end, in units of its covariance CC'.
   Returns 0 for too many torques. */
int stewart_period_misfit(const stewart_period *period, const real *xi, const real *y, const real *C,
                          real *cost, stewart_scratch scratch);

/* Probability that a standard normal number is between x and y. */
real stewart_normal_between(real x, real y);

/* Compute rows K (k, 12): changes of the state at the end if the timing of a single torque is off by one
   standard deviation. The first `others` rows are of torques before the controller's own. The rest are of
   own torques, with the standard deviation `std` in s. K'K is the covariance. Returns k, at most
   STEWART_MAX_SCHEDULE, or -1 for too many torques. */
int stewart_period_late(const stewart_period *period, const real *xi, const real *state, real std,
                        real *K, int *others, stewart_scratch scratch);

/* Advance a hypothesis by a period, and correct it by a measurement y (m) at its end unless NULL. */
void stewart_delay_advance(const stewart_period *period, const stewart_hypothesis *hypothesis, const real *y,
                           stewart_hypothesis *after, stewart_scratch scratch);

int stewart_delay_advance_scratch(int p, int m, int num_in_flight);

/* Memory of the search, in one flat vector. */
typedef struct {
    real eta, rate, num_own;     /* of the `stewart_arrivals` that the law uses; num_own -1 before the first
                                    sample */
    real known;                  /* whether there has been a measurement */
    real searching;              /* whether there are several hypotheses */
    real cells;                  /* number of hypotheses in which an own torque has arrived */
    real best;                   /* place of the most probable hypothesis */
    real rejected;               /* whether the last measurement was an outlier */
    real found;                  /* whether the delay was found at this sample, or at the last one if deferred */
    real deferred;               /* whether it was found at this sample with no time left for a plan: it counts
                                    as settled at the next one */
    real open_loop;              /* whether nothing is fed back until the delay is found */
    real feeds_back;             /* whether the estimate is good enough for feedback */
    real caution;                /* factor on the weight of torques */
    real settled;                /* whether the delay is known */
    real mean, std;              /* s, of the delay; NaN before the first measurement */
    real numbers[];              /* torques that act until an own one arrives (num_in_flight - 1 or 1, 6),
                                    the last two measurements (2, m), then the hypotheses */
} stewart_delay_memory;

/* Numbers of the memory for p parameters, m values and a number of torques in flight at a sample. */
int stewart_delay_size(int p, int m, int num_in_flight);

int stewart_delay_scratch(int p, int m, int num_in_flight);

/* Return the hypothesis at a place: 0 is the master (delay_search.c) or the only one, 1 to `cells` are cells. */
stewart_hypothesis *stewart_delay_hypothesis(int p, int m, int num_in_flight, stewart_delay_memory *memory,
                                             int place);

void stewart_delay_start(const stewart_delay *delay, int num_in_flight, stewart_delay_memory *memory);

/* Advance by a period, and correct by a measurement y (m) at its end unless NULL. `in_flight`
   (num_in_flight, 6) are the torques sent before this sample; `near` (12) is the expected state. */
void stewart_delay_observe(const stewart_delay *delay, int num_in_flight, const real *in_flight,
                           const real *y, const real *near, stewart_delay_memory *memory,
                           stewart_scratch scratch);

/* Settings of the observer of an unknown delay at `law->estimation`: `delay` without machine and
   sensing, which are the law's, as in `stewart_filter_settings`. */
typedef struct {
    stewart_delay delay;
    int values; /* of one sample */
    int most;   /* torques that act until the next one does, at the most */
} stewart_delay_settings;

extern const stewart_observer stewart_delay_observer;
