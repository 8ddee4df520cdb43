/* The processor time of steps on a host: of each step the least of all replays. */

#include <stdio.h>
#include <time.h>

#include "meter.h"

#define STEPS @steps|length@

static clock_t began;
static int replays[STEPS];
static double least[STEPS];

void meter_start(void)
{
    began = clock();
}

void meter_stop(int step)
{
    double took = (double)(clock() - began) / CLOCKS_PER_SEC;
    if (replays[step]++ == 0 || took < least[step])
        least[step] = took;
}

void meter_report(int steps)
{
    double worst = 0, sum = 0;
    for (int k = 0; k < steps; k++) {
        worst = least[k] > worst ? least[k] : worst;
        sum += least[k];
    }
    printf("a step takes %.0f us on average, %.0f us at the most\n", 1e6 * sum / steps, 1e6 * worst);
}
