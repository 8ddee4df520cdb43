/* The exact plant under torques that are known beforehand, and in a loop with a delay. It is
   integrated by DOP853 from one change of the torque to the next, and seen at any time by the
   polynomials of the steps. It ends where the plate leaves its workspace.

   A caller's numbers are not kept, and nothing is allocated: any thread may call. */

#include <math.h>
#include <string.h>

#include "dop853.h"
#include "link.h"
#include "tuner.h"

#define EXPORT __attribute__((visibility("default")))
#define MOTORS 6

/* Of packed.c. */
void change(double *buffer);
void margin(double *buffer);

/* How a run, or a part of it, has ended. */
enum { INSIDE, LEFT, TOO_SHORT_STEPS, CONTROLLER_FAILED };

/* amplitude sin(frequency t + phase), added to a constant torque. */
typedef struct {
    double constant[MOTORS], amplitude[MOTORS], phase[MOTORS], frequency;
} drive;

/* The packed buffers of `change`, which begins with the state, and of `margin`, which begins with the
   pose; and where in them torque and results are. */
typedef struct {
    double *change, *torque, *slope, *margin, *above;
    const drive *sine; /* what the torque is at any time, or NULL where it is constant */
} machine;

/* Instants in s, ascending, and the states there as far as the run has come. */
typedef struct {
    const double *time;
    double *state;
    long number, seen;
} looks;

typedef struct {
    double tolerance, longest, end; /* longest step, s; end of the run, s */
    double time, state[STATES];     /* the start; then where the run has ended */
    long steps, evaluations;
} run;

static void set_torque(machine *m, const drive *d, double time)
{
    for (int i = 0; i < MOTORS; i++)
        m->torque[i] = d->constant[i] + d->amplitude[i] * sin(d->frequency * time + d->phase[i]);
}

static void slope(void *system, double time, const double *x, double *rate)
{
    machine *m = system;
    if (m->sine)
        set_torque(m, m->sine, time);
    memcpy(m->change, x, STATES * sizeof(double));
    change(m->change);
    memcpy(rate, m->slope, STATES * sizeof(double));
}

static int inside(machine *m, const double *x)
{
    memcpy(m->margin, x, MOTORS * sizeof(double));
    margin(m->margin);
    return *m->above > 0.;
}

/* It is inside at `from` and not at `to`: s->x is where it is no longer, to 1e-13 s. By halves, since
   the margin is a least of several, with edges. */
static int leave(dop853 *s, machine *m, double from, double to)
{
    double x[STATES];
    while (to - from > 1e-13 * fmax(1., to)) {
        double middle = from + (to - from) / 2.;
        dop853_at(s, middle, x);
        *(inside(m, x) ? &from : &to) = middle;
    }
    dop853_at(s, to, x);
    s->time = to;
    memcpy(s->x, x, sizeof x);
    return LEFT;
}

/* On to `end`, where the torque changes only as m->sine says. */
static int advance(dop853 *s, machine *m, double end, looks *l)
{
    for (; l->seen < l->number && l->time[l->seen] <= s->time; l->seen++)
        memcpy(l->state + STATES * l->seen, s->x, sizeof s->x);
    if (s->time < end)
        dop853_begin(s);
    while (s->time < end) {
        if (!dop853_step(s, end))
            return TOO_SHORT_STEPS;
        double from = s->before;
        for (; l->seen < l->number && l->time[l->seen] <= s->time; l->seen++) {
            double *x = l->state + STATES * l->seen, to = l->time[l->seen];
            dop853_at(s, to, x);
            if (!inside(m, x))
                return leave(s, m, from, to);
            from = to;
        }
        if (!inside(m, s->x))
            return leave(s, m, from, s->time);
    }
    return INSIDE;
}

static dop853 integrator(const run *r, machine *m)
{
    dop853 s = {.slope = slope, .system = m, .tolerance = r->tolerance, .longest = r->longest};
    s.time = r->time;
    memcpy(s.x, r->state, sizeof s.x);
    return s;
}

static int ended(run *r, const dop853 *s, int how)
{
    r->time = s->time, r->steps = s->steps, r->evaluations = s->evaluations;
    memcpy(r->state, s->x, sizeof s->x);
    return how;
}

/* `number` drives, each from its own time on, the first at the start. */
EXPORT int open_loop(run *r, machine *m, looks *l, const drive *drives, const double *from, long number)
{
    dop853 s = integrator(r, m);
    for (long i = 0; i < number; i++) {
        double until = i + 1 < number ? fmin(from[i + 1], r->end) : r->end;
        int constant = 1;
        for (int j = 0; j < MOTORS; j++)
            constant &= drives[i].amplitude[j] == 0. || drives[i].frequency == 0.;
        m->sine = constant ? NULL : &drives[i];
        set_torque(m, &drives[i], s.time);
        int how = advance(&s, m, until, l);
        if (how != INSIDE)
            return ended(r, &s, how);
    }
    return ended(r, &s, INSIDE);
}

/* The torque (6) of a sample, of its number and the measurement (12); not 0 to give up. */
typedef int (*controller)(void *about, long sample, const double *measurement, double *torque);

/* What stands between a controller and the plant. */
typedef struct {
    long samples;             /* that are taken in the run */
    const double *sampled;    /* when, s */
    double period;            /* between them by the controller's clock, s */
    const double *delays;     /* (samples) of the torques on their way, s */
    const stewart_link *link; /* a wire */
    double *memory;           /* of the link */
    const double *noise;      /* (samples, 12), or NULL */
    double bias[MOTORS];      /* added to what acts */
    double *measured;         /* (samples, 12) result */
    double *asked;            /* (samples, 6) result: torques, without limit */
    long taken;               /* result: samples */
} loop;

static int sample(dop853 *s, loop *o, long k, controller law, void *about)
{
    double *y = o->measured + STATES * k, *torque = o->asked + MOTORS * k, now = o->period * (double)k;
    for (int i = 0; i < STATES; i++)
        y[i] = o->noise ? s->x[i] + o->noise[STATES * k + i] : s->x[i];
    if (law(about, k, y, torque))
        return CONTROLLER_FAILED;
    stewart_link_take(o->link, o->memory, now, (double)(k + 1), 0., now + o->delays[k], 1, torque);
    o->taken = k + 1;
    return INSIDE;
}

static void apply(machine *m, const loop *o)
{
    const double *torque = stewart_link_current(o->memory);
    for (int i = 0; i < MOTORS; i++)
        m->torque[i] = torque[i] + o->bias[i];
}

/* Sample, wait, release, until the run's end. A change of the torque that is together with a sample
   takes place at its instant. */
EXPORT int closed_loop(run *r, machine *m, looks *l, loop *o, controller law, void *about)
{
    dop853 s = integrator(r, m);
    m->sine = NULL;
    apply(m, o);
    for (long k = 0;;) {
        double sampled = k < o->samples ? o->sampled[k] : HUGE_VAL;
        double released = stewart_link_next(o->link, o->memory);
        int samples = sampled <= released + o->link->together, how = INSIDE;
        double next = samples ? sampled : released;
        if (next > r->end)
            return ended(r, &s, advance(&s, m, r->end, l));
        if (next > s.time + o->link->together)
            how = advance(&s, m, next, l);
        if (how == INSIDE && samples)
            how = sample(&s, o, k++, law, about);
        else if (how == INSIDE)
            stewart_link_change(o->link, o->memory, fmax(released, s.time));
        if (how != INSIDE)
            return ended(r, &s, how);
        apply(m, o);
    }
}

/* law.c as a controller, without Python in between; with a tuner, or fixed weights where that is NULL. */
typedef struct {
    const stewart_law *law;
    const stewart_tuner *tuner;
    double *memory, *tuner_memory, *scratch;
    double *previews;        /* of each sample one after the other, `rows` each */
    const double *wanted;    /* (samples, 12) reference, for a tuner */
    double *weights;         /* (samples, 2): given, or with a tuner the result */
    double *kept;            /* (samples, columns) result: rows of the tuner's window */
    long rows, columns;
} law_in_c;

static int step(void *about, long k, const double *measurement, double *torque)
{
    law_in_c *in = about;
    stewart_sample sample = {.measurement = measurement, .reference = stewart_given_rows};
    sample.about = in->previews + STEWART_REFERENCE * in->rows * k;
    memcpy(sample.weights, in->weights + 2 * k, sizeof sample.weights);
    if (!in->tuner) {
        stewart_step(in->law, in->memory, in->scratch, &sample, torque);
        return 0;
    }
    stewart_tuned_step(in->law, in->tuner, in->memory, in->tuner_memory, in->scratch, &sample,
                       in->wanted + STATES * k, torque);
    memcpy(in->weights + 2 * k, sample.weights, sizeof sample.weights);
    stewart_newest_row(in->tuner, in->tuner_memory, in->kept + in->columns * k);
    return 0;
}

/* `closed_loop` with the law in C; `controller` points to a `law_in_c` whose memories have been
   started. */
EXPORT int closed_loop_of_law(run *r, machine *m, looks *l, loop *o, law_in_c *controller)
{
    return closed_loop(r, m, l, o, step, controller);
}
