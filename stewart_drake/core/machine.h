/* The controller's model of a machine, and the motion of its plate under known torques. */

#pragma once

#include "dynamics.h"
#include "matrix.h"

#define STEWART_STATES 12
#define STEWART_MOTORS 6
#define STEWART_MAX_ESTIMATED 25 /* parameters of the plant, and offsets of six encoders */

/* Estimated parameters theta (p) are some of the plant's, or others that do not affect the motion, such as
   offsets of encoders. */
typedef struct stewart_machine {
    real geometry[STEWART_GEOMETRY];
    real parameters[STEWART_PARAMETERS]; /* nominal ones */
    real gravity;                        /* m/s^2 */
    const stewart_joint_friction *joints; /* NULL: none */
    real torque_limit;                   /* of each motor, N m; infinite for none */
    real coarse_torque_limit;            /* N m, limit beyond which substeps are twice as many */
    int substeps;                        /* Runge-Kutta steps per torque */
    int estimated;                       /* p */
    int place[STEWART_MAX_ESTIMATED];    /* of each of them in `parameters`, or -1 */
    const real *acceleration_per_torque; /* (6, 6), of a machine with accelerations = this (torque + bias) at
                                            any pose; NULL: the equations of motion */
    const struct stewart_own_machine *own; /* motion and limit in Python; NULL in an export */
} stewart_machine;

/* Torque schedule: torques that act one after the other, each for its duration. */
typedef struct {
    int number;
    const real *torques;   /* (number, 6) N m */
    const real *durations; /* (number) s */
    int substeps;          /* for each of them; 0: by the largest torque */
} stewart_schedule;

/* Largest number of torques that act in a period under an estimated delay, at a rate within bounds. */
#define STEWART_MAX_SCHEDULE 8

/* Functions in Python for `stewart_predict`, `stewart_limit` and `stewart_at_limit`. */
typedef struct stewart_own_machine {
    void (*predict)(const stewart_machine *machine, const real *theta, const stewart_schedule *schedule,
                    const real *state, real *states);
    int (*limit)(const stewart_machine *machine, const real *torque, real *limited);
    int (*at_limit)(const stewart_machine *machine, int number, const real *torques);
} stewart_own_machine;

/* Torques between two samples, under the assumed delay. */
typedef struct {
    stewart_schedule schedule;
    const real *preceding, *following; /* (6) N m, the torques before and after */
} stewart_interval;

/* A machine with estimated parameters in place of the nominal ones. */
typedef struct {
    stewart_plant plant;
    real parameters[STEWART_PARAMETERS];
    const real *acceleration_per_torque; /* as of the machine */
} stewart_model;

/* Set a model to parameters theta (p), NULL for the nominal ones. It points into itself: do not copy it. */
void stewart_set_model(const stewart_machine *machine, const real *theta, stewart_model *model);

/* Return the Runge-Kutta steps per torque for torques (number, 6). */
int stewart_substeps(const stewart_machine *machine, int number, const real *torques);

/* Return whether any of the torques (number, 6) is at the limit or beyond. */
int stewart_at_limit(const stewart_machine *machine, int number, const real *torques);

/* Compute the second derivative (6) of the pose in a state (12) under a torque (6). */
void stewart_accelerate(const stewart_model *model, const real *state, const real *torque,
                        real *accelerations);

/* Compute the torque (6) for a row of 18 numbers: pose, rates and accelerations. */
void stewart_required_torque(const stewart_model *model, const real *row, real *torque);

/* Advance a state (12) under a torque for a duration in s; `low` as of `stewart_accumulate`. */
void stewart_advance(const stewart_model *model, const real *torque, real duration, int substeps,
                     real *state, real *low);

/* Predict the states (number, 12) after each torque of a schedule, from a state (12). `low` (12) as of
   `stewart_accumulate` is that of the state, then of the last one; or NULL. */
void stewart_predict(const stewart_machine *machine, const real *theta, const stewart_schedule *schedule,
                     const real *state, real *low, real *states);

/* Compute A (12, 12), B (12, 6), G (12, p): derivatives of the state's time derivative by state, torque and
   theta. G may be NULL. Returns 0 where they do not exist. */
int stewart_derivatives(const stewart_machine *machine, const stewart_model *model,
                        const real *state, const real *torque, real *A, real *B, real *G,
                        stewart_scratch scratch);

/* Compute the rows H (12, 12 + p) = [Phi S] of the transition F = [Phi S; 0 1] from xi = [state; theta] to the
   end of each torque, `next` numbers apart; with next = 0 to the end of the last torque only. `states` are
   those of `stewart_predict` from xi. `fourth_order`: Magnus steps of fourth order, else the midpoint rule,
   of second order. Returns 0 where they do not exist. */
int stewart_transitions(const stewart_machine *machine, const real *xi, const stewart_schedule *schedule,
                        int fourth_order, const real *states, int next, real *H, stewart_scratch scratch);

int stewart_transitions_scratch(int estimated);
