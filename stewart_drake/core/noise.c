/* See noise.h. */

#include "noise.h"
#include "short.h"

#define ONE_TORQUE ((real)0.5) /* information of one torque at t = 1: 1 / (2 t^2) */
#define SURE ((real)2.5)
#define WIDER 12
#define ODD 3       /* largest nu^2 / S - 1 of a value in the slope of w */
#define LATEST 1000 /* largest t */
#define UNTIMELY 4  /* t of torques that are off by twice the assumed standard deviation */

void stewart_noise_start(stewart_noise *noise)
{
    *noise = (stewart_noise){.timing = 1};
}

/* Fisher scoring of one factor; 0 for NaN. */
static real scored(real factor, real slope, real information)
{
    const real found = information > 0 ? factor + slope / information : 0;
    return found > 0 ? found : 0;
}

void stewart_noise_learn(int m, const real *innovations, const real *variances, const real *H,
                         const real *timing, int p, const real *G, const real *wander, real keep,
                         stewart_noise *noise)
{
    real timing_slope = 0, wander_slope = 0;
    noise->known_timing *= keep;
    noise->known_wander *= keep;
    for (int i = 0; i < m; i++) {
        const real *h = H + X * i;
        real K = 0, W = 0, S = variances[i];
        for (int j = 0; j < X; j++)
            K += h[j] * h[j] * timing[j];
        for (int k = 0; k < p; k++) {
            real change = 0;
            for (int j = 0; j < X; j++)
                change += h[j] * G[(X + p) * j + X + k];
            change *= wander[k];
            W += change * change;
        }
        const real S_at_w = S - (noise->used - noise->wander) * W; /* not at the factor in use */
        S = S_at_w > S / 10 ? S_at_w : S / 10;
        const real off = innovations[i] * innovations[i] / S - 1;
        timing_slope += K * off / (2 * S);
        wander_slope += W * (off < ODD ? off : ODD) / (2 * S);
        noise->known_timing += K * K / (2 * S * S);
        noise->known_wander += W * W / (2 * S * S);
    }
    const real t = noise->timing > 1 ? noise->timing : 1;
    const real found = scored(noise->timing, timing_slope, noise->known_timing + ONE_TORQUE / (t * t));
    noise->timing = found < LATEST ? found : LATEST;
    noise->wander = scored(noise->wander, wander_slope, noise->known_wander);
    const real excess = noise->wander - SURE / REAL(sqrt)(noise->known_wander);
    noise->used *= REAL(sqrt)(keep);
    if (excess > 0 || noise->timing > UNTIMELY) /* not for NaN */
        noise->asked += (real)m;
    if (WIDER * excess > noise->used)
        noise->used = WIDER * excess;
}

void stewart_kicks(const stewart_machine *machine, const stewart_schedule *schedule,
                   const real *following, const real *state, const real *theta, real *squares)
{
    stewart_belief belief;
    real before[6], after[6], left = 0; /* s from a change of torque to the end */
    stewart_believe(machine, theta, &belief);
    stewart_fill(X, 0, squares);
    for (int k = 0; k < schedule->number; k++)
        left += schedule->durations[k];
    stewart_accelerate(&belief, state, schedule->torques, before);
    for (int k = 0; k < schedule->number; k++) {
        const int last = k + 1 == schedule->number;
        stewart_accelerate(&belief, state, last ? following : schedule->torques + U * (k + 1),
                           after);
        left = last ? 0 : left - schedule->durations[k];
        for (int i = 0; i < 6; i++) {
            const real change = after[i] - before[i];
            squares[i] += left * change * left * change;
            squares[6 + i] += change * change;
            before[i] = after[i];
        }
    }
}
