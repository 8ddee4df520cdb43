/* Motor encoders: six crank angles at samples within a period. */

#pragma once

#include "kinematics.h"
#include "sensing.h"

/* Crank angles y = alpha(q) + offset, six at each of N samples of a period, the oldest first. */
typedef struct {
    const real *geometry;
    int samples;                   /* N, at 1/N, 2/N, ..., 1 of a period */
    int nodes;                     /* M <= 3, at which a motion is compared */
    real quantum;                  /* width of a code, rad; 0 for exact encoders */
    real std;                      /* of one angle, rad */
    real shares[3];                /* (M) of the nodes, of a period */
    real declared[STEWART_STATES]; /* at the beginning; it selects the assembly */
    real rates_std[6];             /* of any first rates, rad/s and m/s */
    real motion[6];                /* how far each coordinate is expected to move, rad and m */
    real offset[6];                /* rad, known beforehand */
    const real *noise_std;         /* (6 N) */
} stewart_encoders;

/* The sensor of a `stewart_encoders`, and that of the last sample of a period alone. */
stewart_sensing stewart_encoder_sensing(const void *sensor);
stewart_sensing stewart_newest_encoders(const void *sensor);

/* Count in `still` (6) the periods for which each leg's code has been constant, with values (6 N) after
   `last`. */
void stewart_count_still(const stewart_sensing *sensing, const real *values, const real *last,
                         real *still);

/* Residuals of values (6 N) with respect to a motion, and their variances.

   The residuals r_n = y_n - h(q(t_n)) - offset of the N samples with respect to a predicted motion are
   small and smooth, so that a parabola approximates them. It is given by its values at the M Gauss nodes
   s_j of the N samples, with V of Legendre polynomials of degrees 0 to M - 1

       e_j = sum_n G_jn r_n,   G = V(s) V(t)^+.

   At these nodes, and no others, the M values of white noise of variance sigma^2 are independent, of
   variance sigma^2 / (N w_j), w_j their Gauss weights. Angles themselves must not be projected: the
   plate does not move along a parabola through them.

   Rounding to codes of width q has the variance q^2 / 12, but it is not white: a leg within one code
   gives the same value at each sample. N samples therefore count as the number of code changes among
   them; after c periods without a change, as 1 / (1 + c)^2 of a sample. */
typedef struct {
    real *angles;   /* (N, 6) rad; NaN where they are left out */
    real *onto;     /* (6, M, M) V(s) (V'V)^-1 of each leg */
    real *variance; /* (M, 6) rad^2 of the values at the nodes; infinite where a leg is left out */
    int odd[6];     /* whether the leg has outliers */
    int missing;    /* whether any value is */
} stewart_reading;

/* Read values (6 N) for predicted angles `shown` (N, 6); `last` (6 N) and `still` (6) as above, with this
   measurement. The caller provides the arrays of the reading. */
void stewart_read(const stewart_encoders *encoders, const real *values, const real *shown,
                  const real *last, const real *still, stewart_reading *reading,
                  stewart_scratch scratch);

/* Compute e (M, 6) of a reading for predicted angles `shown` (N, 6). */
void stewart_node_residuals(const stewart_encoders *encoders, const stewart_reading *reading,
                    const real *shown, real *e);

/* Scratch of `start` and `stewart_read`: numbers at the most. */
int stewart_encoder_scratch(const stewart_encoders *encoders);
