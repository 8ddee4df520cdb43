/* Motor encoders: six crank angles at samples within a period. */

#pragma once

#include "kinematics.h"
#include "sensing.h"

/* Crank angles y = alpha(q) + offset, six at each of N samples of a period, the oldest first. */
typedef struct {
    const real *geometry;
    int samples;                   /* N, at 1/N, 2/N, ..., 1 of a period */
    int nodes;                     /* M <= 3, number of nodes at which a motion is compared */
    real quantum;                  /* width of a code, rad; 0 for exact encoders */
    real std;                      /* of one angle, rad */
    real node_times[3];              /* (M) of the nodes, of a period */
    real initial_state[STEWART_STATES]; /* at the beginning; it selects the assembly */
    real rates_std[6];             /* of any first rates, rad/s and m/s */
    real motion[6];                /* how far each coordinate is expected to move, rad and m */
    real offset[6];                /* rad, known beforehand */
    const real *noise_std;         /* (6 N) */
} stewart_encoders;

/* Sensor models of a `stewart_encoders`: of all samples of a period, and of the last one alone. */
stewart_sensing stewart_encoder_sensing(const void *sensor);
stewart_sensing stewart_newest_encoder_sensing(const void *sensor);

/* Count in `unchanged` (6) the periods for which each leg's code has been constant, by values (6 N) and those
   of the period before, `last`. */
void stewart_count_unchanged(const stewart_sensing *sensing, const real *values, const real *last,
                             real *unchanged);

/* Values (6 N) of a period, compared with a predicted motion.

   The residuals r_n = y_n - h(q(t_n)) - offset of the N samples with respect to a predicted motion are
   small and smooth: a parabola fits them. It is given by its values e_j at the M Gauss nodes s_j of the N
   samples. With V the Legendre polynomials of degrees 0 to M - 1, least squares give

       e_j = sum_n G_jn r_n,   G = V(s) V(t)^+.

   Only at these nodes the values of white noise of variance sigma^2 are independent, with the variance
   sigma^2 / (N w_j) and the Gauss weights w_j. No parabola fits the angles themselves.

   Rounding to codes of width q has the variance q^2 / 12, but it is not white: a leg within one code
   has the same value at each sample. N samples therefore count as many as there are code changes among
   them; after c periods without a change, as 1 / (1 + c)^2 of a sample. The filter adds these as if they were
   independent, but they repeat one rounding error: all of them together count for less than one sample, as

       sum over c >= 1 of 1 / (1 + c)^2 = pi^2 / 6 - 1. */
typedef struct {
    real *angles;   /* (N, 6) rad; NaN where they are left out */
    real *fit;      /* (6, M, M) V(s) (V'V)^-1 of each leg */
    real *variance; /* (M, 6) rad^2 of the values at the nodes; infinite where a leg is left out */
    int has_outliers[6]; /* of each leg */
    int missing;    /* whether any value is missing */
} stewart_reading;

/* Make a reading of values (6 N) for predicted angles (N, 6), with `last` (6 N) and the updated `unchanged`
   (6) as above. The caller provides the arrays of the reading. */
void stewart_read(const stewart_encoders *encoders, const real *values, const real *predicted,
                  const real *last, const real *unchanged, stewart_reading *reading,
                  stewart_scratch scratch);

/* Compute e (M, 6) of a reading for predicted angles (N, 6). */
void stewart_node_residuals(const stewart_encoders *encoders, const stewart_reading *reading,
                            const real *predicted, real *e);

/* Largest number of scratch numbers of `start` and `stewart_read`. */
int stewart_encoder_scratch(const stewart_encoders *encoders);
