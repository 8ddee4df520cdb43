/* Simulation of the exact plant: alone under known torques, or in a loop with a delay.

   DOP853 integrates from one change of the torque to the next, and the polynomials of its steps give
   the state at any time. A run ends where the plate leaves its workspace. Nothing is allocated: any
   thread may call. */

#pragma once

#include "kinematics.h"
#include "link.h"
#include "motion.h"
#include "servo.h"
#include "tuner.h"

/* Hash of the source that this library was compiled from. */
const char *stewart_source(void);

enum { STEWART_INSIDE, STEWART_OUTSIDE, STEWART_TOO_SHORT_STEPS, STEWART_CONTROLLER_FAILED };

/* A run. `time` and `state` are those of its start, then of its end. */
typedef struct {
    const stewart_plant *plant;
    double sign, least[STEWART_NUM_MEASURES]; /* workspace, see `stewart_margin` */
    double tolerance, end;                /* error of a step; end of the run, s */
    long number;                          /* of times at which the state is recorded */
    const double *times;                  /* (number) ascending, s */
    double *states;                       /* (number, 12) result; the first `recorded` are valid */
    long recorded;
    double time, state[STEWART_STATES];
    long steps, evaluations;
    long most_steps; /* after which it ends with STEWART_TOO_SHORT_STEPS; 0 for no such limit */
} stewart_run;

/* Position servos by stiffness: the torque at each crank is

       clip(k (u - alpha) - k_v alpha_dot, limit),

   u the setpoint, alpha the crank's angle; whole turns do not count. Beyond the workspace it stays finite.
   Damping, Coulomb friction and armature of a servo are the plant's, see dynamics.h. */
typedef struct {
    double stiffness;     /* k, N m/rad */
    double velocity_gain; /* k_v, N m s/rad */
    double torque_limit;  /* N m, infinite for none */
} stewart_position_servo;

/* Torques (6) of six servos at a state (12), for setpoints (6), and those without limit in `asked` (6). */
void stewart_position_torque(const stewart_position_servo *servo, const double *geometry,
                             const double *setpoint, const double *state, double *asked, double *torque);

/* Run under commands (number, 6), each from its time on (number) in s, the first one from the start on: torques
   without a servo, else its setpoints. Returns how the run has ended. */
int stewart_open_loop(stewart_run *run, const stewart_position_servo *servo, long number,
                      const double *from, const double *commands);

/* Controller at a sample: write its torque (6) without limit, and the command (rows, 6) that it sends.
   The sample has measurement, age and report only. Returns 0, or 1 to end the run. */
typedef int (*stewart_controller)(void *context, long number, const stewart_sample *sample,
                                  double *torque, double *command);

/* Connection of a controller and the plant. */
typedef struct {
    long samples;             /* in the run */
    const double *sampled;    /* (samples) their times, s */
    double period;            /* of the controller's clock, s */
    const stewart_link *link; /* to the motors: a wire, or a buffer of packets */
    double *memory;           /* of the link */
    const double *transit;    /* (samples) transit time of each command, s; infinite for a lost one */
    int rows;                 /* torques of a command, 1 on a wire */
    int repeats;              /* number of these that precede the torque of the sample */
    double delay;             /* of a buffer, from a sample to the action of its torque, periods */
    const double *noise;      /* (samples, 12), or NULL */
    const stewart_link *back; /* a wire for measurements and reports, or NULL: without delay */
    double *back_memory;
    const double *back_transit; /* (samples) s; infinite for a lost measurement */
    int reported;               /* periods of a report, 0 for none */
    double bias[STEWART_MOTORS]; /* added to the torque at the plant */
    double push[6], push_from, push_to; /* wrench on the plate between two times, s; infinite: never */
    double *wrench;              /* (6) place of the wrench among the plant's parameters */
    const stewart_position_servo *servo; /* commands begin with its setpoints (6); NULL: with torques */
    double *scratch;          /* 12 + 7 reported + 6 rows numbers */
    double *measured;         /* (samples, 12) result: measurements as the controller gets them */
    double *asked;            /* (samples, 6) result: torques without limit, of servos at the samples */
    long taken;               /* result: number of samples */
    long saturated;           /* result: periods in which a servo reached its limit */
} stewart_loop;

int stewart_closed_loop(stewart_run *run, stewart_loop *loop, stewart_controller law, void *context);

/* The law of law.h, or of servo.h without reports, as the controller. The caller has started its memories. */
typedef struct {
    const stewart_law *law;
    const stewart_servo *servos; /* or NULL */
    const stewart_tuner *tuner; /* NULL for fixed weights */
    double *memory, *tuner_memory, *scratch;
    stewart_known_motion motion; /* its `now` is set at each sample */
    double period;               /* of the samples, s, see `event_time` of Drake's loop */
    const double *wanted; /* (samples, 12) reference, for a tuner */
    double *weights;      /* (samples, 2) given, or result of the tuner */
    double *tuner_rows;   /* (samples, columns) result: rows of the tuner's window */
    long columns;
    int rows; /* torques of a command */
    const double *report; /* of servos, of NaN */
} stewart_law_in_loop;

int stewart_closed_loop_of_law(stewart_run *run, stewart_loop *loop, stewart_law_in_loop *law);
