/* Replays a run recorded in Python and compares the torques. */

#include <math.h>
#include <stdio.h>

#include "meter.h"
#include "stewart_config.h"

#define STEPS @steps|length@
#ifndef REPEATS
#ifdef __SANITIZE_ADDRESS__ /* steps are slow, and their time means nothing */
#define REPEATS 2
#else
#define REPEATS 20
#endif
#endif
#define TOLERANCE @tolerance@

static const real measurement[STEPS][STEWART_MEASUREMENT_SIZE] = {
    @steps|map(attribute="measurement")|rows@};
static const int age[STEPS] = {@steps|map(attribute="age")|join(", ")@};

#include "replay.h"

static const real expected[STEPS][ANSWER] = {
    @steps|map(attribute="answer")|rows@};
static const int status[STEPS] = {@steps|map(attribute="status")|join(", ")@};

int main(void)
{
    double error = 0, peak = 0;
    int different = 0;
    for (int repeat = 0; repeat < REPEATS; repeat++) {
        begin();
        for (int k = 0; k < STEPS; k++) {
            real found[ANSWER];
            meter_start();
            int returned = answer(k, found);
            meter_stop(k);
            after_step(k);
            different += (returned & ~STEWART_MEASUREMENT_PARTIAL) != status[k];
            for (int i = 0; i < ANSWER; i++) {
                double off = fabs((double)(found[i] - expected[k][i]));
                double size = fabs((double)expected[k][i]);
                error = off > error || isnan(off) ? off : error;
                peak = size > peak ? size : peak;
            }
        }
    }
    int passed = error <= TOLERANCE * peak && different == 0;
    printf("%s: %d steps, largest error %.1e of the peak of %.3g @"rad, rad/s or N m" if servos else "N m"@, tolerance %.0e\n",
           passed ? "passed" : "failed", STEPS, error / (peak > 0 ? peak : 1), peak, TOLERANCE);
    printf("statuses that differ: %d\n", different);
    meter_report(STEPS);
    printf("state %u B, configuration %u B, workspace %u B\n", (unsigned)sizeof memory,
           (unsigned)sizeof stewart_configuration, (unsigned)sizeof scratch);
    return passed ? 0 : 1;
}
