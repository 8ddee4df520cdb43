/* Every public function of an exported controller with arguments that nobody should give it: finite
   torques come out, and what is remembered stays finite. Compiled under the sanitizers. */

#include <limits.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include "stewart_config.h"
#include "stewart_motion.h"

enum { SAMPLES = 12, MANY = 4096 };

static const real odd[] = {NAN, INFINITY, -INFINITY, (real)1e30, (real)-1e30, 0};
static const int places[] = {INT_MIN, INT_MIN + 1, -MANY / 2, -1, 0, 1, 2, MANY, INT_MAX - 1, INT_MAX};
enum { ODD = sizeof odd / sizeof *odd, PLACES = sizeof places / sizeof *places };

static stewart_memory memory;
static stewart_workspace work;
static real many[MANY * STEWART_MOTORS];
static int failed;

static void expect(int holds, const char *what, int sample)
{
    if (!holds)
        printf("sample %d: %s\n", sample, what);
    failed |= !holds;
}

/* What is given at one sample, and which of its numbers is replaced. */
typedef struct {
    int sample, age, ago, number;
    int measurement, reference, weight, acted; /* -1 for none */
    int lost; /* whole previews, from `sample` on */
    real value;
} oddity;

static const oddity none = {-1, 0, 1, 0, -1, -1, -1, -1, 0, 0};

static void run(oddity o)
{
    const stewart_config *c = &stewart_configuration;
    real times[STEWART_PREVIEW], preview[STEWART_PREVIEW * STEWART_REFERENCE];
    int rows = stewart_preview_times(c, times), counted = 0, status = 0;
    stewart_init(c, &memory, stewart_queue);
    for (int k = 0; k < SAMPLES; k++) {
        real torque[STEWART_MOTORS], weights[2] = {1, 1}, measurement[STEWART_REFERENCE];
        for (int i = 0; i < rows; i++)
            stewart_reference((double)(k * c->period + times[i]), preview + STEWART_REFERENCE * i);
        stewart_reference((double)(k * c->period), measurement);
        if (k == o.sample) {
            if (o.measurement >= 0)
                measurement[o.measurement] = o.value;
            if (o.reference >= 0)
                preview[o.reference] = o.value;
            if (o.weight >= 0)
                weights[o.weight] = o.value;
            for (int i = 0; i < MANY * STEWART_MOTORS; i++)
                many[i] = o.acted >= 0 && i % STEWART_MOTORS == o.acted ? o.value : 0;
            stewart_acted(c, &memory, o.ago, o.number, many);
            if (o.acted >= 0)
                stewart_sent(c, &memory, many);
        }
        for (int i = 0; o.lost && i < rows * STEWART_REFERENCE; i++)
            if (k >= o.sample && k < o.sample + o.lost)
                preview[i] = o.value;
        status = stewart_step(c, &memory, &work, measurement, k == o.sample ? o.age : 0, preview,
                              weights, torque);
        counted += (status & STEWART_REFERENCE_MISSING) != 0;
        for (int i = 0; i < STEWART_MOTORS; i++) {
            expect(isfinite(torque[i]), "a torque is no number", k);
            expect(isfinite(memory.integral[i]), "the integral is no number", k);
            expect(isfinite(memory.error[i]), "the error is no number", k);
        }
    }
    expect(counted == (isfinite(o.value) ? 0 : o.lost + (o.reference >= 0)), "references are miscounted", -1);
    expect(isfinite(memory.state[0]), "the state is no number at the end", -1);
}

int main(void)
{
    real times[STEWART_PREVIEW], row[STEWART_REFERENCE];
    int rows = stewart_preview_times(&stewart_configuration, times);
    for (int v = 0; v < ODD; v++)
        for (int at = 0; at < 2; at++) {
            oddity o = none;
            o.sample = 5 * at;
            o.value = odd[v];
            for (o.measurement = 0; o.measurement < STEWART_STATES; o.measurement += 5)
                run(o);
            o.measurement = -1;
            for (o.reference = 0; o.reference < rows * STEWART_REFERENCE; o.reference += 97)
                run(o);
            o.reference = -1;
            for (o.weight = 0; o.weight < 2; o.weight++)
                run(o);
            o.weight = -1;
            for (o.lost = 1; o.lost < 8 && !isfinite(o.value); o.lost += 2)
                run(o);
            o.lost = 0;
            o.acted = v;
            o.number = 3;
            run(o);
        }
    for (int i = 0; i < PLACES; i++) {
        oddity o = none;
        o.sample = 5;
        o.age = places[i];
        run(o);
        stewart_init(&stewart_configuration, &memory, stewart_queue);
        for (int j = 0; j < PLACES; j++)
            stewart_acted(&stewart_configuration, &memory, places[i], places[j], many);
    }
    for (int v = 0; v < ODD; v++) {
        for (int i = 0; i < MANY * STEWART_MOTORS; i++)
            many[i] = odd[v];
        stewart_init(&stewart_configuration, &memory, many);
        for (int i = 0; i < STEWART_IN_FLIGHT; i++)
            expect(isfinite(memory.in_flight[i][0]), "a torque in flight is no number", i);
        stewart_reference((double)odd[v], row);
        for (int i = 0; i < STEWART_REFERENCE; i++)
            expect(isfinite(row[i]), "the motion is no number", i);
    }
    printf("odd inputs: %s\n", failed ? "failed" : "survived");
    return failed;
}
