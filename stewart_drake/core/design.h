/* The gain: a linear model of the error where the next torque acts, its cost, and the feedforward. */

#pragma once

#include "machine.h"
#include "riccati.h"

#define STEWART_REFERENCE 18 /* pose, rates and accelerations */

/* Ways to find the torque that the reference takes. */
enum { STEWART_NO_FEEDFORWARD, STEWART_EQUILIBRIUM, STEWART_INVERSE_DYNAMICS };

/* w_Q [e; z]' Q [e; z] + w_R T' R T with diagonal Q and R. */
typedef struct {
    real errors[6], integrals[6], torques[6];
    int integrates; /* whether the law has an integral z */
    int feedforward;
} stewart_cost;

/* Torques of the holds: of the pending one, if any, and of the next. */
typedef struct {
    real torque[2][6], change[4][6]; /* changes over the same holds and a neighbour each */
} stewart_held;

/* Numbers of the state that the gain multiplies: error, integral, torque that is still to act. */
int stewart_order(const stewart_cost *cost, int pending);

/* Feedforward (hold), with its changes, from the reference at two nodes of each of 3 + pending holds:
   `nodes` (2 (3 + pending), 18). */
void stewart_hold(const stewart_machine *machine, const stewart_cost *cost, const real *theta,
                  int pending, const real *nodes, stewart_held *held);

/* Subtract from an error (12) the offset that held torques cause at the sample whose error is regulated,
   for the first two changes (2, 6) of `stewart_held` and B (6, 6), accelerations per torque. */
void stewart_subtract_offset(real period, real fraction, const real *changes, const real *B,
                             real *error);

/* Linear model where a torque acts: A (12, 12), B (12, 6) of the error. The offset that held torques
   cause is subtracted from `error` (12); the pending torque acts for another `fraction` of a period.
   Returns 0, or the cause of failure, of `stewart_status`. */
int stewart_linearize(const stewart_machine *machine, const real *theta, real period, real fraction,
                      const real *state, const stewart_held *held, real *A, real *B, real *error,
                      stewart_scratch scratch);

/* Gain K (6, order) of a linear model, for weights w_Q and w_R. Returns 0 where there is none. */
int stewart_gain(const stewart_cost *cost, real period, real fraction, const real *A, const real *B,
                 const real *weights, real *K, stewart_scratch scratch);

/* T = T_ff - K [error; integral; late - its feedforward], in the place of T (6), which is T_ff. `late`
   (pending, 6) are the torques that are still to act, `feedforward` (pending, 6) theirs. */
void stewart_feed_back(const stewart_cost *cost, const real *K, const real *error,
                       const real *integral, int pending, const real *late, const real *feedforward,
                       real *torque);

int stewart_linearize_scratch(void);
int stewart_gain_scratch(const stewart_cost *cost, int pending);
