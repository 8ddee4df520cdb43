/* A predictive LQI controller with delay compensation for a rotary Stewart platform.

   Once:           stewart_start(&law, memory, number, queue);
   every period:   status = stewart_step(&law, memory, scratch, &sample, torque);
   if another torque than the limited `torque` was sent:
                   stewart_note_acted(&law, memory, 1, 1, sent);

   A pose is roll, pitch, yaw (rad) and x, y, z (m) of the plate's centre of mass, a state the pose
   and its rates, a reference the pose, its rates and its accelerations. Matrices are stored by rows.
   No memory is allocated. All state, counts and flags included, is in the caller's vector `memory`;
   `law.layout` names its fields. */

#pragma once

#define STEWART_REPORTED 10 /* periods in a report of torques, at the most */

#include "design.h"
#include "observer.h"
#include "packets.h"

/* A field of the memory: its place, and its size as a matrix. */
typedef struct {
    int at, rows, columns;
} stewart_field;

typedef struct {
    stewart_field in_flight;   /* limited torques, the oldest first */
    stewart_field observer;    /* memory of the observer after its last measurement */
    stewart_field lag;         /* age of that measurement, periods */
    stewart_field state;       /* estimate at this sample */
    stewart_field parameters;  /* estimated, else assumed */
    stewart_field measurement; /* the last one, unchanged */
    stewart_field error;       /* of the pose */
    stewart_field integral;
    stewart_field gain;        /* the last finite one; NaN before the first */
    stewart_field torque;      /* the last one, before the limit */
    stewart_field feedforward; /* share of `torque` without feedback */
    stewart_field weights;
    stewart_field silence;     /* samples left without feedback */
    stewart_field times;       /* of the last preview, s from its sample */
    stewart_field reference;   /* the last preview, with missing numbers filled in */
    stewart_field followed;    /* `reference` and the way back onto it after a gap */
    stewart_field gap;         /* whether the last row of the last preview was missing */
    stewart_field offset;      /* from the reference where the next torque acts, after a gap in it */
    stewart_field way_back;    /* holds until the offset is zero; then samples until it has acted */
    stewart_field channel;     /* packets that were sent */
    stewart_field planner;     /* memory of the planner */
    stewart_field counts;      /* samples with each bit of `stewart_status` */
} stewart_layout;

/* Prediction at the instant from which the next torque acts; a channel plans further torques from it. */
typedef struct {
    real state[STEWART_STATES], error[STEWART_STATES], integral[6];
    real limited[STEWART_MOTORS]; /* the torque within the motors' limit, N m */
    const real *theta;            /* parameters that it is computed with; NULL: the assumed ones */
    const real *gain;             /* or NULL without feedback */
    const real *rows;             /* of the reference, at further instants of the preview */
} stewart_predicted;

/* Functions in place of the core's; NULL: that of the core. */
typedef struct {
    int columns; /* of the gain, at the most */
    /* Change the outlook, which is that of the core under the assumed delay; the state is `lag` periods
       after the one that was observed. */
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
    /* Plan again if that is useful, once at each sample. Returns whether it did. */
    int (*follow)(const stewart_law *law, real *memory, const stewart_outlook *outlook,
                  const stewart_sample *sample, stewart_scratch scratch);
    /* Rows (number, 18) of that motion, at instants in s from now. */
    void (*rows)(const stewart_law *law, const real *memory, const stewart_sample *sample, int number,
                 const real *times, real *rows);
} stewart_planner;

/* The constants of one controller. */
struct stewart_law {
    stewart_machine machine;
    stewart_cost cost;
    real period;       /* s */
    real fraction;     /* of the assumed delay: its rest, periods */
    int steps;         /* of the assumed delay: whole periods */
    int kept;          /* torques in memory besides those in flight */
    int longest_wait;  /* periods: the greatest age of a measurement */
    int silence;       /* samples at the start without feedback */
    real tolerated_timing; /* s; the weight of torques grows if their timing deviates more; 0: weights as given */
    int measured;      /* size of a measurement */
    int parts;         /* torques of a period that a machine reports; 0: the law's own act */
    int rows;          /* largest number of rows in a preview */
    int memory;        /* numbers of the memory, and the place of each field: `stewart_prepare` */
    stewart_layout layout;
    const stewart_observer *observer;
    const stewart_design *design;     /* NULL: prediction and gain of the core */
    const void *sensing, *estimation; /* assumptions of the observer */
    stewart_sensing (*read)(const void *sensing); /* the model of the sensor */
    const stewart_sensing *described; /* replaces `sensing`; or NULL */
    const stewart_channel *channel;   /* NULL: every torque arrives, after the delay */
    const stewart_packets *packets;   /* assumptions of the channel */
    const stewart_planner *planner;   /* NULL: the law follows the caller's reference */
    const void *planning;             /* assumptions of the planner */
};

/* Rows (number, 18) of the reference at instants in s from now, some of them negative. */
typedef void (*stewart_preview_function)(void *context, int number, const real *times, real *rows);

/* Input of a sample. */
struct stewart_sample {
    const real *measurement; /* (measured); what is lost is NaN */
    int age;                 /* of it in periods; negative for a lost one. One that is not newer than
                                the last one used, or older than `longest_wait`, is missing */
    /* NaN or infinite numbers of the reference are filled in from neighbouring rows and the last
       preview; after a gap the law goes back onto it. Until the first complete row the torque is the
       last one in flight. */
    stewart_preview_function reference;
    stewart_preview_function goal; /* that plans lead back to; from the first plan on it is read in
                                      the place of `reference`; NULL: no plan is made */
    void *context;                 /* first argument of both */
    const stewart_report *report; /* that came with the measurement, or NULL */
    real weights[2]; /* of errors and of torques; if one is not finite, the last gain is used */
};

/* Fill in `memory` and `layout` from the other fields of a law. */
void stewart_prepare(stewart_law *law);

/* Numbers of scratch memory that a step takes at the most. */
int stewart_step_scratch(const stewart_law *law);

/* Torques in flight at a sample, by the assumed delay. */
int stewart_queue_length(const stewart_law *law);

/* Before the first step; `queue` (number, 6) has the torques that are under way, the oldest first. */
void stewart_start(const stewart_law *law, real *memory, int number, const real *queue);

/* One sample: the torque (6) to send; it is not limited: apply `stewart_limit` before you send it.
   Returns what went wrong, bits of `stewart_status`. `scratch` has place for `stewart_step_scratch`
   numbers. */
int stewart_step(const stewart_law *law, real *memory, real *scratch, const stewart_sample *sample,
                 real *torque);

/* Pass torques that acted, if they differ from the sent ones. `torques`: `number` rows, newest first.
   Row i replaces the torque that was computed `ago` + i samples before the next step (`ago` = 1: the
   last step). Torques that are older than the memory, or not finite, change nothing. */
void stewart_note_acted(const stewart_law *law, real *memory, int ago, int number, const real *torques);

/* A `stewart_preview_function` that copies its rows from `context`. */
void stewart_given_rows(void *context, int number, const real *times, real *rows);

/* Compute the feedforward `torques` (1 + pending, 6): of the pending ones, then of the next. The
   reference is given at two `nodes` of each of 3 + pending holds. If `error` (12) is given, subtract from
   it the offset that held torques cause in a state (12). If `weights` are given, compute the gain K
   (6, `stewart_order`). Returns 0, or the cause of failure, of `stewart_status`. */
int stewart_design_feedback(const stewart_law *law, const stewart_outlook *outlook, const real *theta,
                            const real *nodes, const real *state, const real *weights, real *torques,
                            real *error, real *K, stewart_scratch scratch);

/* Plan the torques (`channel->torques`, 6) of this sample and of further ones: the model continues from the
   end of the prediction, under feedback with the same gain. `late` (pending, 6) are still to act. */
void stewart_plan_torques(const stewart_law *law, const stewart_outlook *outlook,
                          const stewart_predicted *ahead, const real *late, real *plan,
                          stewart_scratch scratch);
int stewart_planning_scratch(const stewart_law *law);

/* Limit a torque. Returns whether that changed it. */
int stewart_limit(const stewart_machine *machine, const real *torque, real *limited);

/* Return the schedule of `periods` periods. In each the older torque acts for `fraction` of it, then the
   next one. `torques` (periods + 1, 6), the oldest first. */
stewart_schedule stewart_schedule_of(real period, real fraction, int periods, const real *torques,
                                     stewart_scratch *scratch);

/* For observers of a fixed delay: torques of the last `periods` of those sent (number, 6). */
stewart_interval stewart_last_periods(const stewart_law *law, int number, const real *torques, int periods,
                                      stewart_scratch *scratch);
