/* Motor encoders: what is measured of six crank angles within a period. */

#pragma once

#include "kinematics.h"
#include "sensing.h"

/* Crank angles, six at each of N samples of a period, the oldest first: y = alpha(q) + offset. */
typedef struct {
    const real *geometry;
    int samples;                   /* N, at 1/N, 2/N, ..., 1 of a period */
    int nodes;                     /* M <= 3, at which a motion is compared */
    real quantum;                  /* width of a code, rad; 0 for exact encoders */
    real std;                      /* of one angle, rad */
    real shares[3];                /* (M) of a period, where the nodes are */
    real declared[STEWART_STATES]; /* at the beginning: which of the assemblies it is */
    real rates_std[6];             /* of any first rates, rad/s and m/s */
    real motion[6];                /* how far each coordinate is expected to move, rad and m */
    real offset[6];                /* rad, as far as it is known beforehand */
    const real *noise_std;         /* (6 N) */
} stewart_encoders;

/* The sensor of a `stewart_encoders`, and that of the last sample of a period alone. */
stewart_sensing stewart_encoder_sensing(const void *sensor);
stewart_sensing stewart_newest_encoders(const void *sensor);

/* What is wrong with values (6 N), or 0: they are of use as long as one leg is. */
int stewart_encoder_fault(const stewart_encoders *encoders, const real *values);

/* `still` (6), periods of each leg without a change of code, with values (6 N) after `last`. */
void stewart_encoders_stood(const stewart_encoders *encoders, const real *values, const real *last,
                            real *still);

/* What values (6 N) say beside a motion, and for how much that counts.

   With r_n = y_n - h(q(t_n)) - offset the residuals of the N samples beside a predicted motion, which
   the model makes small and smooth, a parabola holds what they say. It is given by its values at the
   M Gauss nodes s_j of the N samples, with V of Legendre polynomials of degrees 0 to M - 1

       e_j = sum_n G_jn r_n,   G = V(s) V(t)^+.

   At these nodes, and no others, the M values of white noise of variance sigma^2 are independent, of
   variance sigma^2 / (N w_j), w_j their Gauss weights. Angles themselves must not be projected: a
   parabola through them is no motion of the plate.

   Rounding to codes of width q is no white noise. Its variance is q^2 / 12, but a leg that does not
   reach the next code says the same however often it is read: N samples count for the number of code
   changes among them; without one, after c periods without any, for 1 / (1 + c)^2 of a sample. */
typedef struct {
    real *angles;   /* (N, 6) rad; NaN where they are left out */
    real *onto;     /* (6, M, M) V(s) (V'V)^-1 of each leg */
    real *variance; /* (M, 6) rad^2 of the values at the nodes; infinite where a leg is left out */
    int odd[6];     /* whether samples of the leg stand out of their period */
    int missing;    /* whether any value is */
} stewart_reading;

/* Read values (6 N) beside angles (N, 6) that a motion shows, `last` (6 N) and `still` (6) as above,
   with this measurement. The reading is in the scratch memory that the caller took for it. */
void stewart_read(const stewart_encoders *encoders, const real *values, const real *shown,
                  const real *last, const real *still, stewart_reading *reading,
                  stewart_scratch scratch);

/* e (M, 6) of a reading beside shown angles (N, 6). */
void stewart_beside(const stewart_encoders *encoders, const stewart_reading *reading,
                    const real *shown, real *e);

/* Scratch of `start` and `stewart_read`: numbers at the most. */
int stewart_encoder_scratch(const stewart_encoders *encoders);
