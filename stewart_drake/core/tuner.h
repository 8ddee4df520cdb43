/* Weights of the law at run time: features of the loop, and policies that decide by them. */

#pragma once

#include "law.h"

#define STEWART_WINDOW 31 /* samples that a decision rests on */
#define STEWART_FEATURES 18

/* Policies: a network as the paper has it, which moves each weight by a factor; a network that has a
   start and moves along the ratio w_Q / w_R; a rule of two lines for that ratio; or fixed weights. */
enum { STEWART_PAPER_NETWORK, STEWART_RATIO_NETWORK, STEWART_RULE, STEWART_FIXED_WEIGHTS };

typedef struct {
    int health;         /* whether features are of health, else the paper's densities */
    int is_signed;      /* whether densities have a sign */
    real noise[STEWART_STATES];     /* standard deviation of a measurement */
    real motion[STEWART_STATES];    /* half the peak to peak of the reference, and that per second */
    real tolerance[STEWART_STATES]; /* tolerable error */
    real torque;        /* largest that the reference takes, N m */
    int doubts;         /* whether parameters are estimated */
    real prior[STEWART_MAX_ESTIMATED]; /* standard deviations of the parameters */
    real delay;         /* believed delay times the reference's angular frequency */
    int policy;
    real first[2];      /* weights of the first sample, and to go back to */
    real ratio, slope, knee; /* of the rule */
    int hidden, logarithms;  /* neurons; whether the network gives logarithms of weights */
    const real *input_mean, *input_scale; /* (18) */
    const real *W1, *b1, *W2, *b2;        /* (hidden, 18), (hidden), (2, hidden), (2) */
    real bounds[4];     /* lower, then upper ones of w_Q and w_R */
} stewart_tuner;

/* Inputs of a tuner: of a law at a sample, and at the sample before. */
typedef struct {
    const stewart_machine *machine;
    const real *state, *theta; /* estimated at the sample before; NaN without an estimate */
    stewart_schedule schedule; /* torques since then */
    const real *following;     /* the torque that acts next */
    const real *measured;      /* (12) state at the sample, as it is measured or else estimated */
    const real *torque[2], *feedforward[2]; /* of the sample, and of the one before */
    const real *std;           /* (p) of the estimated parameters */
} stewart_tuner_input;

/* Numbers of the tuner's memory: weights of the last sample, fallbacks, the window (31, columns), the
   newest row last. */
int stewart_tuner_memory(const stewart_tuner *tuner);

void stewart_tuner_start(const stewart_tuner *tuner, real *memory);

/* Features (18) of a window. */
void stewart_tuner_features(const stewart_tuner *tuner, const real *window, real *values);

/* Weights (2) of the next sample. Returns whether the policy failed and the weights go back. */
int stewart_decide(const stewart_tuner *tuner, const real *memory, real *weights);

/* The same for given features (18) and weights (2) of the last sample. */
int stewart_decide_by(const stewart_tuner *tuner, const real *values, const real *last, real *weights);

/* Takes a sample into the memory: `wanted` (12) is the reference's pose and rates, `weights` (2) those
   that were used. Scratch: 12 numbers for each torque of the schedule. */
void stewart_tuner_observe(const stewart_tuner *tuner, real *memory, const stewart_tuner_input *input,
                           const real *wanted, const real *weights, int fell_back,
                           stewart_scratch scratch);

/* `stewart_step` with weights of a tuner, which observes it; those of `sample` do not count. */
int stewart_tuned_step(const stewart_law *law, const stewart_tuner *tuner, real *memory,
                       real *tuner_memory, real *scratch, stewart_sample *sample,
                       const real *wanted, real *torque);

int stewart_tuned_step_scratch(const stewart_law *law);
