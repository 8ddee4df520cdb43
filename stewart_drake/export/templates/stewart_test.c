/* Replays what the reference in Python was given and compares what it answered. What was sent then is
   handed to the controller after each sample: alone, without a plant, it would make more of every
   rounding with each further one. */

#include <math.h>
#include <stdio.h>
#include <time.h>

#include "stewart_config.h"

#define STEPS @STEPS@
#define ROWS @PREVIEW@
#define REPEATS 20
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
static double least[STEPS];

int main(void)
{
    double error = 0, peak = 0, worst = 0, sum = 0;
    int different = 0;
    for (int repeat = 0; repeat < REPEATS; repeat++) {
        stewart_init(&stewart_configuration, &memory, stewart_queue);
        for (int k = 0; k < STEPS; k++) {
            real torque[STEWART_MOTORS];
            clock_t began = clock();
            int found = stewart_step(&stewart_configuration, &memory, &work, measurement[k], age[k],
                                     preview[k], weights[k], torque);
            double took = (double)(clock() - began) / CLOCKS_PER_SEC;
            stewart_sent(&stewart_configuration, &memory, sent[k]);
            least[k] = repeat == 0 || took < least[k] ? took : least[k];
            different += found != status[k];
            for (int i = 0; i < STEWART_MOTORS; i++) {
                double off = fabs((double)(torque[i] - expected[k][i]));
                double size = fabs((double)expected[k][i]);
                error = off > error || isnan(off) ? off : error;
                peak = size > peak ? size : peak;
            }
        }
    }
    for (int k = 0; k < STEPS; k++) {
        worst = least[k] > worst ? least[k] : worst;
        sum += least[k];
    }
    printf("%d steps, largest error %.1e of the peak torque of %.3g N m, tolerance %.0e\n", STEPS,
           error / peak, peak, TOLERANCE);
    printf("statuses that differ: %d\n", different);
    printf("a step takes %.0f us, at the most %.0f us (least of %d repeats each)\n",
           1e6 * sum / STEPS, 1e6 * worst, REPEATS);
    printf("state %u B, configuration %u B, workspace %u B\n", (unsigned)sizeof memory,
           (unsigned)sizeof stewart_configuration, (unsigned)sizeof work);
    return error <= TOLERANCE * peak && different == 0 ? 0 : 1;
}
