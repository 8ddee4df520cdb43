/* Runge-Kutta steps of order 8 for dx/dt = f(x), with error control, and a polynomial of order 7 within each step. */

#pragma once

#define STATES 12
#define STAGES 16

/* dx/dt of a system. */
typedef void (*slope_function)(void *system, const double *x, double *slope);

typedef struct {
    slope_function slope;
    void *system;
    double tolerance;  /* of the error of a step: relative and absolute */
    double time, x[STATES];
    double next_step;  /* largest step that the error allows, s; 0 for none known yet */
    double before, start[STATES]; /* time and state at which the last step began */
    double slopes[STAGES][STATES]; /* of its stages */
    double within[7][STATES];     /* coefficients of its polynomial */
    int has_polynomial;
    long steps, evaluations;
} dop853;

/* Call this before the first step, and wherever the slope has jumped. */
void dop853_begin(dop853 *s);

/* Take one step, at most up to `end`. Returns 0 if no step is short enough. */
int dop853_step(dop853 *s, double end);

/* Interpolate the state at a time within the last step. */
void dop853_at(dop853 *s, double time, double *x);
