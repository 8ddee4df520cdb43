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

static real memory[STEWART_MEMORY], scratch[STEWART_SCRATCH];
static real times[STEWART_PREVIEW], preview[STEWART_PREVIEW * STEWART_REFERENCE];
static int rows, asked_at;
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

/* The motion at instants from a sample on. */
static void look_ahead(int k)
{
    for (int i = 0; i < rows; i++)
        stewart_reference((double)((real)k * stewart_configuration.period + times[i]),
                          preview + STEWART_REFERENCE * i);
}

/* Remembers the instants that are asked for. */
static void ask(void *about, int number, const real *at, real *wanted)
{
    (void)about;
    rows = number;
    for (int i = 0; i < number; i++)
        times[i] = at[i];
    look_ahead(asked_at);
    stewart_given_rows(preview, number, at, wanted);
}

static void start(void)
{
    stewart_start(&stewart_configuration, memory, stewart_queue_rows, stewart_queue);
}

static void run(oddity o)
{
    const stewart_law *law = &stewart_configuration;
    const stewart_layout *l = &law->layout;
    int counted = 0, status = 0;
    start();
    for (int k = 0; k < SAMPLES; k++) {
        real torque[STEWART_MOTORS], measurement[STEWART_REFERENCE];
        stewart_sample sample = {.measurement = measurement, .reference = stewart_given_rows};
        sample.context = preview;
        sample.weights[0] = sample.weights[1] = 1;
        look_ahead(k);
        stewart_reference((double)((real)k * law->period), measurement);
        if (k == o.sample) {
            sample.age = o.age;
            if (o.measurement >= 0)
                measurement[o.measurement] = o.value;
            if (o.reference >= 0)
                preview[o.reference] = o.value;
            if (o.weight >= 0)
                sample.weights[o.weight] = o.value;
            for (int i = 0; i < MANY * STEWART_MOTORS; i++)
                many[i] = o.acted >= 0 && i % STEWART_MOTORS == o.acted ? o.value : 0;
            stewart_note_acted(law, memory, o.ago, o.number, many);
            if (o.acted >= 0)
                stewart_note_acted(law, memory, 1, 1, many);
        }
        for (int i = 0; o.lost && i < rows * STEWART_REFERENCE; i++)
            if (k >= o.sample && k < o.sample + o.lost)
                preview[i] = o.value;
        status = stewart_step(law, memory, scratch, &sample, torque);
        counted += (status & STEWART_REFERENCE_MISSING) != 0;
        for (int i = 0; i < STEWART_MOTORS; i++) {
            expect(isfinite(torque[i]), "a torque is no number", k);
            expect(isfinite(memory[l->integral.at + i]), "the integral is no number", k);
            expect(isfinite(memory[l->error.at + i]), "the error is no number", k);
        }
    }
    expect(counted == (isfinite(o.value) ? 0 : o.lost + (o.reference >= 0)), "references are miscounted", -1);
    expect(isfinite(memory[l->state.at]), "the state is no number at the end", -1);
}

/* A step on memory that nobody started. */
static void forget_start(real value)
{
    const stewart_law *law = &stewart_configuration;
    real torque[STEWART_MOTORS], measurement[STEWART_MEASUREMENT_SIZE] = {0}, limited[STEWART_MOTORS];
    stewart_sample sample = {.measurement = measurement, .reference = ask, .weights = {1, 1}};
    for (int i = 0; i < STEWART_MEMORY; i++)
        memory[i] = value;
    expect(stewart_step(law, memory, scratch, &sample, torque) == STEWART_NOT_STARTED, "started", 0);
    stewart_limit(&law->machine, torque, limited);
    for (int i = 0; i < STEWART_MOTORS; i++)
        expect(torque[i] == 0 && limited[i] == 0, "a torque without a start", i);
}

int main(void)
{
    const stewart_law *law = &stewart_configuration;
    real torque[STEWART_MOTORS], row[STEWART_REFERENCE], measurement[STEWART_MEASUREMENT_SIZE];
    stewart_sample first = {.measurement = measurement, .reference = ask, .weights = {1, 1}};
    for (int i = 0; i < STEWART_MEASUREMENT_SIZE; i++)
        measurement[i] = (real)NAN;
    start();
    stewart_step(law, memory, scratch, &first, torque);
    for (int v = 0; v < ODD; v++)
        forget_start(odd[v]);
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
        start();
        for (int j = 0; j < PLACES; j++)
            stewart_note_acted(law, memory, places[i], places[j], many);
    }
    for (int v = 0; v < ODD; v++) {
        for (int i = 0; i < MANY * STEWART_MOTORS; i++)
            many[i] = odd[v];
        stewart_start(law, memory, MANY, many);
        for (int i = 0; i < law->layout.in_flight.rows; i++)
            expect(isfinite(memory[law->layout.in_flight.at + STEWART_MOTORS * i]),
                   "a torque in flight is no number", i);
        stewart_reference((double)odd[v], row);
        for (int i = 0; i < STEWART_REFERENCE; i++)
            expect(isfinite(row[i]), "the motion is no number", i);
    }
    printf("odd inputs: %s\n", failed ? "failed" : "survived");
    return failed;
}
