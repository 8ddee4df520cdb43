/* Replays what the reference in Python was given and compares what it answered. What was sent then is
   handed to the controller after each sample: alone, without a plant, it would make more of every
   rounding with each further one. */

#include <math.h>
#include <stdio.h>

#include "meter.h"
#include "stewart_config.h"

#define STEPS @STEPS@
#define ROWS @PREVIEW@
#ifndef REPEATS
#define REPEATS 20
#endif
#define TOLERANCE @TOLERANCE@

static const real measurement[STEPS][STEWART_STATES] = {
    @MEASUREMENT@};
static const real preview[STEPS][ROWS * STEWART_REFERENCE] = {
    @PREVIEW_ROWS@};
static const real weights[STEPS][2] = {
    @WEIGHTS@};
static const real expected[STEPS][STEWART_MOTORS] = {
    @TORQUE@};
static const real sent[STEPS][STEWART_MOTORS] = {
    @SENT@};
static const int age[STEPS] = {@AGE@};
static const int status[STEPS] = {@STATUS@};

static stewart_memory memory;
static stewart_workspace work;

int main(void)
{
    double error = 0, peak = 0;
    int different = 0;
    for (int repeat = 0; repeat < REPEATS; repeat++) {
        stewart_init(&stewart_configuration, &memory, stewart_queue);
        for (int k = 0; k < STEPS; k++) {
            real torque[STEWART_MOTORS];
            meter_start();
            int found = stewart_step(&stewart_configuration, &memory, &work, measurement[k], age[k],
                                     preview[k], weights[k], torque);
            meter_stop(k);
            stewart_sent(&stewart_configuration, &memory, sent[k]);
            different += found != status[k];
            for (int i = 0; i < STEWART_MOTORS; i++) {
                double off = fabs((double)(torque[i] - expected[k][i]));
                double size = fabs((double)expected[k][i]);
                error = off > error || isnan(off) ? off : error;
                peak = size > peak ? size : peak;
            }
        }
    }
    printf("%d steps, largest error %.1e of the peak torque of %.3g N m, tolerance %.0e\n", STEPS,
           error / peak, peak, TOLERANCE);
    printf("statuses that differ: %d\n", different);
    meter_report(STEPS);
    printf("state %u B, configuration %u B, workspace %u B\n", (unsigned)sizeof memory,
           (unsigned)sizeof stewart_configuration, (unsigned)sizeof work);
    return error <= TOLERANCE * peak && different == 0 ? 0 : 1;
}
