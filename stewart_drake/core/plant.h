/* The exact plant in simulation: alone under known torques, or in a loop with a delay.

   DOP853 integrates from one change of the torque to the next, and the polynomials of its steps give
   the state at any time. A run ends where the plate leaves its workspace. Nothing is allocated: any
   thread may call. */

#pragma once

#include "link.h"
#include "tuner.h"

/* Hash of the source that this library was compiled from. */
const char *stewart_source(void);

/* Least distance of the measures of a pose above `least` (8); NaN if one of them is NaN. `sign` is that
   of the parallel measure at home. */
double stewart_margin(const double *geometry, const double *pose, double sign, const double *least);

/* States (number, 12) after Runge-Kutta steps of h (number) seconds under torques (number, 6). */
void stewart_steps(const stewart_plant *plant, long number, const double *state,
                   const double *torques, const double *h, double *states);

enum { STEWART_INSIDE, STEWART_LEFT, STEWART_TOO_SHORT_STEPS, STEWART_CONTROLLER_FAILED };

/* One run. The state is the start, then the last one. */
typedef struct {
    const stewart_plant *plant;
    double sign, least[STEWART_MEASURES]; /* workspace, see `stewart_margin` */
    double tolerance, longest, end;       /* error of a step; longest step, s; end of the run, s */
    long number;                          /* instants at which the state is wanted */
    const double *times;                  /* (number) ascending, s */
    double *states;                       /* (number, 12) result, of which `seen` are known */
    long seen;
    double time, state[STEWART_STATES];
    long steps, evaluations;
} stewart_run;

/* Torque constant + amplitude sin(frequency t + phase) from the time `from` on, s. */
typedef struct {
    double constant[STEWART_MOTORS], amplitude[STEWART_MOTORS], phase[STEWART_MOTORS];
    double frequency, from;
} stewart_drive;

/* Run under drives (number), the first from the start on. Returns how the run has ended. */
int stewart_open_loop(stewart_run *run, const stewart_drive *drives, long number);

/* The torque (6) for a measurement (12) at a sample. Returns 0, or 1 to end the run. */
typedef int (*stewart_controller)(void *about, long sample, const double *measurement,
                                  double *torque);

/* Connection of a controller and the plant. */
typedef struct {
    long samples;             /* in the run */
    const double *sampled;    /* (samples) instants, s */
    double period;            /* by the controller's clock, s */
    const double *delays;     /* (samples) of the torques, s */
    const stewart_link *link; /* a wire */
    double *memory;           /* of the link */
    const double *noise;      /* (samples, 12), or NULL */
    double bias[STEWART_MOTORS]; /* added to the torque at the plant */
    double *measured;         /* (samples, 12) result */
    double *asked;            /* (samples, 6) result: torques without limit */
    long taken;               /* result: samples */
} stewart_loop;

int stewart_closed_loop(stewart_run *run, stewart_loop *loop, stewart_controller law, void *about);

/* The law of law.h as the controller; its memories have been started. */
typedef struct {
    const stewart_law *law;
    const stewart_tuner *tuner; /* NULL for fixed weights */
    double *memory, *tuner_memory, *scratch;
    double *previews;     /* (samples, rows, 18) */
    const double *wanted; /* (samples, 12) reference, for a tuner */
    double *weights;      /* (samples, 2) given, or result of the tuner */
    double *kept;         /* (samples, columns) result: rows of the tuner's window */
    long rows, columns;
} stewart_law_in_loop;

int stewart_closed_loop_of_law(stewart_run *run, stewart_loop *loop, stewart_law_in_loop *law);
