/* Feedforward and gain, from a linear model of the error where the next torque acts. */

#pragma once

#include "machine.h"
#include "riccati.h"

#define STEWART_REFERENCE 18 /* pose, rates and accelerations */

/* Kinds of feedforward. */
enum { STEWART_NO_FEEDFORWARD, STEWART_EQUILIBRIUM, STEWART_INVERSE_DYNAMICS };

/* w_Q [e; z]' Q [e; z] + w_R T' R T with diagonal Q and R. */
typedef struct {
    real errors[6], integrals[6], torques[6];
    int integrates; /* whether the law has an integral z */
    int feedforward;
} stewart_cost;

/* Feedforward torques of the pending hold, if there is one, and of the next hold; and the change of
   the exact torque over these holds and their two neighbours. */
typedef struct {
    real torque[2][6], change[4][6];
} stewart_feedforward;

/* Number of states that the gain multiplies: error, integral, pending torques. */
int stewart_order(const stewart_cost *cost, int pending);

/* Compute the feedforward from the reference at the two Gauss nodes of each of 3 + pending holds:
   `nodes` (2 (3 + pending), 18). See equation (hold) in design.c. */
void stewart_hold_feedforward(const stewart_machine *machine, const stewart_cost *cost, const real *theta,
                              int pending, const real *nodes, stewart_feedforward *held);

/* Subtract from an error (12) the offset that held torques cause at the sample whose error is regulated,
   for the first two changes (2, 6) of a feedforward and B (6, 6), accelerations per torque. */
void stewart_subtract_offset(real period, real fraction, const real *changes, const real *B,
                             real *error);

/* Compute the continuous model A (12, 12), B (12, 6) of the error at a state where a torque begins to act.
   Subtract the offset that held torques cause from `error` (12). The pending torque acts for another
   `fraction` of a period. Returns 0, or the cause of failure, of `stewart_status`. */
int stewart_linearize(const stewart_machine *machine, const real *theta, real period, real fraction,
                      const real *state, const stewart_feedforward *held, real *A, real *B, real *error,
                      stewart_scratch scratch);

/* Compute the gain K (6, order) of a linear model, for weights w_Q and w_R. Returns 0, or the cause of
   failure. */
int stewart_gain(const stewart_cost *cost, real period, real fraction, const real *A, const real *B,
                 const real *weights, real *K, stewart_scratch scratch);

/* T <- T - K [error; integral; pending_torques - feedforward], for T (6), which holds the feedforward of
   the next hold. `pending_torques` and `feedforward` are (pending, 6). */
void stewart_feed_back(const stewart_cost *cost, const real *K, const real *error,
                       const real *integral, int pending, const real *pending_torques, const real *feedforward,
                       real *torque);

int stewart_linearize_scratch(void);
int stewart_gain_scratch(const stewart_cost *cost, int pending);
