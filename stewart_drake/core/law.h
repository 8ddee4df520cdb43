/* A predictive LQI controller with delay compensation for a rotary Stewart platform.

   Once:           stewart_start(&law, memory, number, queue);
   every period:   status = stewart_step(&law, memory, scratch, &sample, torque);
   if another torque than the limited `torque` was sent:
                   stewart_note_acted(&law, memory, 1, 1, sent);

   A pose is roll, pitch, yaw (rad) and x, y, z (m) of the plate's centre of mass, a state the pose
   and its rates, a reference the pose, its rates and its accelerations. Matrices are stored by rows.
   No memory is allocated. All state, counts and flags included, is in the caller's vector `memory`;
   `law.layout` names its fields.

   The lag of an estimate is the age of its last measurement. The outlook of a sample (observer.h) is the
   estimate now with the torques that act until the next one does. A hold is a period in which one torque
   acts; a torque is pending where it still acts at the end of the prediction. */

#pragma once

#define STEWART_REPORTED 10 /* periods in a report of torques, at the most */
#define STEWART_STARTED 22499 /* in memory that was started; any number that others hardly have */

#include "design.h"
#include "observer.h"
#include "packets.h"

/* A field of the memory: its place, and its size as a matrix. */
typedef struct {
    int at, rows, columns;
} stewart_field;

typedef struct {
    stewart_field command;     /* of servos, sent last */
    stewart_field in_flight;   /* limited torques, the oldest first */
    stewart_field observer;    /* memory of the observer after its last measurement */
    stewart_field lag;         /* age of that measurement, periods */
    stewart_field state;       /* estimate at this sample */
    stewart_field parameters;  /* estimated, else assumed */
    stewart_field measurement; /* the last one, unchanged */
    stewart_field error;       /* of the pose at this sample */
    stewart_field integral;    /* of that error */
    stewart_field gain;        /* the last finite one; NaN before the first */
    stewart_field torque;      /* the last one, before the limit */
    stewart_field feedforward; /* part of `torque` without feedback */
    stewart_field weights;
    stewart_field open_loop_samples; /* that remain without feedback */
    stewart_field times;       /* of the last preview, s from its sample */
    stewart_field reference;   /* the last preview, with missing numbers filled in */
    stewart_field followed;    /* `reference` with the blend onto it after a gap */
    stewart_field gap;         /* whether the last row of the last preview was incomplete */
    stewart_field blend;       /* offset (12), holds and samples of a `stewart_blend` */
    stewart_field channel;     /* packets that were sent */
    stewart_field planner;     /* memory of the planner */
    stewart_field counts;      /* samples with each bit of `stewart_status` */
    stewart_field started;     /* STEWART_STARTED */
} stewart_layout;

/* Prediction to the time at which the next torque begins to act; a channel plans further torques from it. */
typedef struct {
    real state[STEWART_STATES], error[STEWART_STATES], integral[6];
    real limited[STEWART_MOTORS]; /* the torque within the motors' limit, N m */
    const real *theta;            /* parameters of the prediction; NULL: the nominal ones */
    const real *gain;             /* or NULL without feedback */
    const real *rows;             /* of the reference, at further times of the preview */
} stewart_predicted;

/* Prediction and gain in Python; a function that is NULL is that of the core. */
typedef struct {
    int columns; /* of the gain, at the most */
    /* Change the outlook, which is that of the core under the assumed delay and has the state `lag` periods
       after the last measurement. */
    void (*outlook)(const stewart_law *law, int lag, stewart_outlook *outlook);
    /* Fill in state, error and integral, for the rows to follow and the integral (6) now. */
    void (*predict)(const stewart_law *law, const stewart_outlook *outlook, const real *followed,
                    const real *integral, stewart_predicted *ahead);
    /* As `stewart_design_feedback`. */
    int (*design)(const stewart_law *law, const stewart_outlook *outlook, const real *theta,
                  const real *nodes, const real *state, const real *weights, real *torques,
                  real *error, real *K);
} stewart_design;

/* A kind of channel to the motors, with which more than one torque is sent at a sample. */
typedef struct {
    int (*memory)(const stewart_law *law);
    int (*scratch)(const stewart_law *law);
    int (*torques)(const stewart_law *law); /* that are planned at each sample */
    void (*start)(const stewart_law *law, real *memory);
    /* Replace the torques in flight by the most probable ones. */
    void (*update)(const stewart_law *law, real *memory, const stewart_report *report,
                   real *in_flight, stewart_scratch scratch);
    /* Keep the packet: this torque and planned ones; `in_flight` are those before. */
    void (*send)(const stewart_law *law, real *memory, const stewart_outlook *outlook,
                 const stewart_predicted *ahead, const real *in_flight, stewart_scratch scratch);
} stewart_channel;

extern const stewart_channel stewart_network;

typedef struct stewart_sample stewart_sample;

/* A kind of planner: it chooses the motion to follow. */
typedef struct {
    int (*memory)(const stewart_law *law);
    int (*scratch)(const stewart_law *law);
    void (*start)(const stewart_law *law, real *memory);
    /* Called once at each sample: plan anew where the prediction requires it. Returns whether it did. */
    int (*follow)(const stewart_law *law, real *memory, const stewart_outlook *outlook,
                  const stewart_sample *sample, stewart_scratch scratch);
    /* Rows (number, 18) of that motion, at times in s from now. */
    void (*rows)(const stewart_law *law, const real *memory, const stewart_sample *sample, int number,
                 const real *times, real *rows);
} stewart_planner;

/* The constants of one controller. */
struct stewart_law {
    stewart_machine machine;
    stewart_cost cost;
    real period;       /* s */
    int steps;         /* mu, whole periods of the assumed delay */
    real fraction;     /* rest of the assumed delay, periods */
    int extra_torques; /* torques in memory beyond those of the assumed delay */
    int longest_wait;  /* greatest age of a measurement, periods */
    int open_loop_samples; /* samples at the start without feedback */
    real tolerated_timing; /* s; the weight of torques grows if their timing varies more; 0: weights as given */
    int num_values;    /* m, values of a measurement */
    int parts;         /* torques per period that a machine reports; 0: the law's own torques act */
    int rows;          /* largest number of rows in a preview */
    int memory;        /* numbers of the memory; `stewart_prepare` sets this and `layout` */
    stewart_layout layout;
    const stewart_observer *observer;
    const stewart_design *design;     /* prediction and gain in Python; NULL in an export */
    const void *estimation;           /* settings of the observer */
    const void *sensing;              /* settings of the sensor, argument of `make_sensing` */
    stewart_sensing (*make_sensing)(const void *sensing);
    const stewart_sensing *own_sensing; /* a sensor model in Python; NULL in an export */
    const stewart_channel *channel;   /* NULL: every torque arrives, after the delay */
    const stewart_packets *packets;   /* settings of the channel */
    const stewart_planner *planner;   /* NULL: the law follows the caller's reference */
    const void *planning;             /* settings of the planner */
};

/* Write the rows (number, 18) of the reference at times in s from now, some of them negative. */
typedef void (*stewart_preview_function)(void *context, int number, const real *times, real *rows);

/* Input of a sample. */
struct stewart_sample {
    const real *measurement; /* (num_values); lost values are NaN */
    int age;                 /* of the measurement, periods; negative for a lost one. A measurement counts
                                as missing if it is not newer than the last one used, or older than
                                `longest_wait` */
    /* NaN or infinite numbers of the reference are filled in from neighbouring rows and the last
       preview (reference.h). Until the first complete row the torque is the last one in flight. */
    stewart_preview_function reference;
    stewart_preview_function goal; /* motion to which plans lead; from the first plan on it replaces
                                      `reference`; NULL: no plan is made */
    void *context;                 /* first argument of both */
    const stewart_report *report; /* that came with the measurement, or NULL */
    real weights[2]; /* w_Q and w_R; if one is not finite, the last gain is used */
};

/* Fill in `memory` and `layout` from the other fields of a law. */
void stewart_prepare(stewart_law *law);

/* Largest number of scratch numbers of a step. */
int stewart_step_scratch(const stewart_law *law);

/* Number of torques in flight at a sample, under the assumed delay. */
int stewart_queue_length(const stewart_law *law);

/* Call before the first step. `queue` (number, 6) has the torques in flight, the oldest first. The oldest one
   is taken to have acted before, too. Of more than the memory holds, the newest are taken. */
void stewart_start(const stewart_law *law, real *memory, int number, const real *queue);

/* Compute the torque (6) of a sample. It is not limited: apply `stewart_limit` before you send it.
   Returns the problems, bits of `stewart_status`. `scratch` has place for `stewart_step_scratch` numbers. */
int stewart_step(const stewart_law *law, real *memory, real *scratch, const stewart_sample *sample,
                 real *torque);

/* Pass torques that acted, if they differ from the sent ones. `torques`: `number` rows, newest first.
   Row i replaces the torque that was computed `ago` + i samples before the next step (`ago` = 1: the
   last step). Torques that are older than the memory, or not finite, change nothing. */
void stewart_note_acted(const stewart_law *law, real *memory, int ago, int number, const real *torques);

/* A `stewart_preview_function` that copies its rows from `context`. */
void stewart_given_rows(void *context, int number, const real *times, real *rows);

/* Compute the feedforward `torques` (1 + pending, 6) of the pending holds, then of the next one. The
   reference is given at two `nodes` of each of 3 + pending holds. If `error` (12) is given, subtract from
   it the offset that held torques cause in a state (12). If `weights` are given, compute the gain K
   (6, `stewart_order`). Returns 0, or the cause of failure, of `stewart_status`. */
int stewart_design_feedback(const stewart_law *law, const stewart_outlook *outlook, const real *theta,
                            const real *nodes, const real *state, const real *weights, real *torques,
                            real *error, real *K, stewart_scratch scratch);

/* Plan the torques (`channel->torques`, 6) of this sample and of further ones: the model continues from the
   end of the prediction, under feedback with the same gain. `pending_torques` (pending, 6) still act then. */
void stewart_plan_torques(const stewart_law *law, const stewart_outlook *outlook,
                          const stewart_predicted *ahead, const real *pending_torques, real *plan,
                          stewart_scratch scratch);
int stewart_planning_scratch(const stewart_law *law);

/* Limit a torque (6). Returns whether that changed it. */
int stewart_limit(const stewart_machine *machine, const real *torque, real *limited);

/* Reserve a field at the end of the memory. */
stewart_field stewart_place(stewart_law *law, int rows, int columns);

/* Add to a count, which stops near a million: beyond 2^24 a float does not count on. */
void stewart_count(int number, real *count);

/* Return the schedule of `periods` periods. In each the older torque acts for `fraction` of it, then the
   next one. `torques` (periods + 1, 6) begin with the oldest. */
stewart_schedule stewart_schedule_of(real period, real fraction, int periods, const real *torques,
                                     stewart_scratch *scratch);

/* Return the largest number of torques that act in the periods since the last measurement. */
int stewart_most_acting(const stewart_law *law);

/* Return the schedule of the last `periods` periods under the assumed delay, from torques (number, 6). */
stewart_interval stewart_last_periods(const stewart_law *law, int number, const real *torques, int periods,
                                      stewart_scratch *scratch);
