/* See plant.h. */

#include <string.h>

#include "dop853.h"
#include "plant.h"
#include "short.h"

#ifndef SOURCE
#define SOURCE ""
#endif

const char *stewart_source(void) { return SOURCE; }

double stewart_margin(const double *geometry, const double *pose, double sign, const double *least)
{
    double measures[STEWART_MEASURES], margin = HUGE_VAL;
    stewart_measures(geometry, pose, NULL, measures);
    measures[6] *= sign;
    for (int i = 0; i < STEWART_MEASURES; i++) {
        const double above = measures[i] - least[i];
        if (above < margin || isnan(above))
            margin = above;
    }
    return margin;
}

void stewart_steps(const stewart_plant *plant, long number, const double *state,
                   const double *torques, const double *h, double *states)
{
    for (long k = 0; k < number; k++, state = states, states += X) {
        stewart_copy(X, state, states);
        stewart_move(plant, torques + U * k, h[k], states);
    }
}

/* The plant of a run under its torque; `drive` gives a torque that changes with time, else NULL. */
typedef struct {
    stewart_run *run;
    const stewart_drive *drive;
    double torque[U];
} driven;

static void set_torque(driven *d, const stewart_drive *drive, double time)
{
    for (int i = 0; i < U; i++)
        d->torque[i] = drive->constant[i] + drive->amplitude[i] * sin(drive->frequency * time + drive->phase[i]);
}

static void slope(void *system, double time, const double *x, double *rate)
{
    driven *d = system;
    if (d->drive)
        set_torque(d, d->drive, time);
    stewart_change(d->run->plant, x, d->torque, rate);
}

static int inside(const stewart_run *r, const double *x)
{
    return stewart_margin(r->plant->geometry, x, r->sign, r->least) > 0.;
}

/* Bisect for the instant between `from`, inside, and `to`, outside, to 1e-13 s; s->x is the state just
   outside. The margin is a minimum of several measures and therefore not smooth. */
static int leave(dop853 *s, const stewart_run *r, double from, double to)
{
    double x[X];
    while (to - from > 1e-13 * fmax(1., to)) {
        double middle = from + (to - from) / 2.;
        dop853_at(s, middle, x);
        *(inside(r, x) ? &from : &to) = middle;
    }
    dop853_at(s, to, x);
    s->time = to;
    stewart_copy(X, x, s->x);
    return STEWART_LEFT;
}

/* Advance to `end`, up to which the torque is smooth. */
static int advance(dop853 *s, stewart_run *r, double end)
{
    for (; r->seen < r->number && r->times[r->seen] <= s->time; r->seen++)
        stewart_copy(X, s->x, r->states + X * r->seen);
    if (s->time < end)
        dop853_begin(s);
    while (s->time < end) {
        if (!dop853_step(s, end))
            return STEWART_TOO_SHORT_STEPS;
        double from = s->before;
        for (; r->seen < r->number && r->times[r->seen] <= s->time; r->seen++) {
            double *x = r->states + X * r->seen, to = r->times[r->seen];
            dop853_at(s, to, x);
            if (!inside(r, x))
                return leave(s, r, from, to);
            from = to;
        }
        if (!inside(r, s->x))
            return leave(s, r, from, s->time);
    }
    return STEWART_INSIDE;
}

static dop853 integrator(driven *d)
{
    const stewart_run *r = d->run;
    dop853 s = {.slope = slope, .system = d, .tolerance = r->tolerance, .longest = r->longest};
    s.time = r->time;
    stewart_copy(X, r->state, s.x);
    return s;
}

static int ended(stewart_run *r, const dop853 *s, int how)
{
    r->time = s->time, r->steps = s->steps, r->evaluations = s->evaluations;
    stewart_copy(X, s->x, r->state);
    return how;
}

int stewart_open_loop(stewart_run *r, const stewart_drive *drives, long number)
{
    driven d = {.run = r};
    dop853 s = integrator(&d);
    int how = STEWART_INSIDE;
    for (long i = 0; i < number && how == STEWART_INSIDE; i++) {
        const stewart_drive *drive = drives + i;
        int constant = 1;
        for (int j = 0; j < U; j++)
            constant &= drive->amplitude[j] == 0. || drive->frequency == 0.;
        d.drive = constant ? NULL : drive;
        set_torque(&d, drive, s.time);
        how = advance(&s, r, i + 1 < number ? fmin(drive[1].from, r->end) : r->end);
    }
    return ended(r, &s, how);
}

static int sample(const dop853 *s, stewart_loop *o, long k, stewart_controller law, void *about)
{
    double *y = o->measured + X * k, *torque = o->asked + U * k, now = o->period * (double)k;
    for (int i = 0; i < X; i++)
        y[i] = o->noise ? s->x[i] + o->noise[X * k + i] : s->x[i];
    if (law(about, k, y, torque))
        return STEWART_CONTROLLER_FAILED;
    stewart_link_take(o->link, o->memory, now, (double)(k + 1), 0., now + o->delays[k], 1, torque);
    o->taken = k + 1;
    return STEWART_INSIDE;
}

/* Take samples and release torques until the run's end. A change of the torque that coincides with a
   sample takes place at the sample's instant. */
int stewart_closed_loop(stewart_run *r, stewart_loop *o, stewart_controller law, void *about)
{
    driven d = {.run = r};
    dop853 s = integrator(&d);
    for (long k = 0;;) {
        for (int i = 0; i < U; i++)
            d.torque[i] = stewart_link_current(o->memory)[i] + o->bias[i];
        double sampled = k < o->samples ? o->sampled[k] : HUGE_VAL;
        double released = stewart_link_next(o->link, o->memory);
        int samples = sampled <= released + o->link->together, how = STEWART_INSIDE;
        double next = samples ? sampled : released;
        if (next > r->end)
            return ended(r, &s, advance(&s, r, r->end));
        if (next > s.time + o->link->together)
            how = advance(&s, r, next);
        if (how == STEWART_INSIDE && samples)
            how = sample(&s, o, k++, law, about);
        else if (how == STEWART_INSIDE)
            stewart_link_change(o->link, o->memory, fmax(released, s.time));
        if (how != STEWART_INSIDE)
            return ended(r, &s, how);
    }
}

static int step(void *about, long k, const double *measurement, double *torque)
{
    stewart_law_in_loop *in = about;
    stewart_sample sample = {.measurement = measurement, .reference = stewart_given_rows};
    sample.about = in->previews + STEWART_REFERENCE * in->rows * k;
    stewart_copy(2, in->weights + 2 * k, sample.weights);
    if (!in->tuner) {
        stewart_step(in->law, in->memory, in->scratch, &sample, torque);
        return 0;
    }
    stewart_tuned_step(in->law, in->tuner, in->memory, in->tuner_memory, in->scratch, &sample,
                       in->wanted + X * k, torque);
    stewart_copy(2, sample.weights, in->weights + 2 * k);
    stewart_newest_row(in->tuner, in->tuner_memory, in->kept + in->columns * k);
    return 0;
}

int stewart_closed_loop_of_law(stewart_run *run, stewart_loop *loop, stewart_law_in_loop *law)
{
    return stewart_closed_loop(run, loop, step, law);
}
