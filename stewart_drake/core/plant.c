#include <string.h>

#include "dop853.h"
#include "legs.h"
#include "planning.h"
#include "plant.h"
#include "reference.h"
#include "short.h"

#ifndef SOURCE
#define SOURCE ""
#endif

const char *stewart_source(void) { return SOURCE; }

/* The plant of a run with the source of its torque. */
typedef struct {
    stewart_run *run;
    const stewart_position_servo *servo; /* turns setpoints into torques, NULL for none */
    double torque[U], setpoint[U], bias[U];
    int at_limit; /* whether a servo has reached its limit since the last sample */
} DrivenPlant;

void stewart_position_torque(const stewart_position_servo *servo, const double *geometry,
                             const double *setpoint, const double *state, double *asked, double *torque)
{
    const double *rates = state + 6, limit = servo->torque_limit;
    const Turn turn = turn_of(state);
    /* Angular velocity of the plate. */
    const double w[3] = {dot(turn.E[0], rates), dot(turn.E[1], rates), dot(turn.E[2], rates)};
    for (int i = 0; i < LEGS; i++) {
        const Leg leg = leg_of(geometry, i);
        const LegMotion motion = leg_motion_of(&leg, &turn, state, w, rates + 3);
        /* `remainder` is within half a turn: whole turns do not count. */
        const double error = remainder(setpoint[i] - motion.angle, TURN);
        asked[i] = servo->stiffness * error - servo->velocity_gain * motion.rate;
        torque[i] = fmax(-limit, fmin(limit, asked[i]));
    }
}

static void servo_torques(const DrivenPlant *d, const double *x, double *asked, double *torque)
{
    stewart_position_torque(d->servo, d->run->plant->geometry, d->setpoint, x, asked, torque);
}

/* Note whether a servo is at its limit. This is not done in `slope`, whose step may be rejected. */
static void note_limit(DrivenPlant *d, const double *x)
{
    double asked[U], torque[U];
    if (!d->servo)
        return;
    servo_torques(d, x, asked, torque);
    for (int i = 0; i < U; i++)
        d->at_limit |= fabs(asked[i]) > d->servo->torque_limit;
}

/* Let a command (6) act: a torque, or a setpoint of the servos. */
static void hold(DrivenPlant *d, const double *command)
{
    for (int i = 0; i < U; i++) {
        d->setpoint[i] = command[i];
        d->torque[i] = command[i] + d->bias[i];
    }
}

static void slope(void *system, const double *x, double *rate)
{
    DrivenPlant *d = system;
    if (d->servo) {
        double asked[U];
        servo_torques(d, x, asked, d->torque);
        for (int i = 0; i < U; i++)
            d->torque[i] += d->bias[i];
    }
    stewart_change(d->run->plant, x, d->torque, rate);
}

static int inside(const stewart_run *r, const double *x)
{
    return stewart_margin(r->plant->geometry, x, r->sign, r->least) > 0.;
}

/* Bisect, to 1e-13 s, for the time of leaving between `from`, inside, and `to`, outside. Then s->x is the state
   just outside. The margin is a minimum of several measures and therefore not smooth. */
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
    return STEWART_OUTSIDE;
}

/* Advance to `end`, up to which the command is constant, and record the states at the run's times. */
static int advance(dop853 *s, stewart_run *r, double end)
{
    for (; r->recorded < r->number && r->times[r->recorded] <= s->time; r->recorded++)
        stewart_copy(X, s->x, r->states + X * r->recorded);
    if (s->time < end) {
        note_limit(s->system, s->x);
        dop853_begin(s);
    }
    while (s->time < end) {
        if ((r->most_steps > 0 && s->steps >= r->most_steps) || !dop853_step(s, end))
            return STEWART_TOO_SHORT_STEPS;
        double last_inside = s->before;
        for (; r->recorded < r->number && r->times[r->recorded] <= s->time; r->recorded++) {
            double *x = r->states + X * r->recorded, time = r->times[r->recorded];
            dop853_at(s, time, x);
            if (!inside(r, x))
                return leave(s, r, last_inside, time);
            last_inside = time;
        }
        note_limit(s->system, s->x);
        if (!inside(r, s->x))
            return leave(s, r, last_inside, s->time);
    }
    return STEWART_INSIDE;
}

static dop853 integrator(DrivenPlant *d)
{
    const stewart_run *r = d->run;
    dop853 s = {.slope = slope, .system = d, .tolerance = r->tolerance};
    s.time = r->time;
    stewart_copy(X, r->state, s.x);
    return s;
}

/* Write the end into the run; return the outcome. */
static int finish(stewart_run *r, const dop853 *s, int outcome)
{
    r->time = s->time, r->steps = s->steps, r->evaluations = s->evaluations;
    stewart_copy(X, s->x, r->state);
    return outcome;
}

int stewart_open_loop(stewart_run *r, const stewart_position_servo *servo, long number,
                      const double *from, const double *commands)
{
    DrivenPlant d = {.run = r, .servo = servo};
    dop853 s = integrator(&d);
    int outcome = STEWART_INSIDE;
    for (long i = 0; i < number && outcome == STEWART_INSIDE; i++) {
        hold(&d, commands + U * i);
        outcome = advance(&s, r, i + 1 < number ? fmin(from[i + 1], r->end) : r->end);
    }
    return finish(r, &s, outcome);
}

/* Write the report of a buffer: `arrived` (reported), whether each of the last packets has arrived, and `acted`
   (reported, 6), the torques of the last periods, the newest first. */
static void write_report(const stewart_loop *o, long k, double *arrived, double *acted)
{
    const double until = o->period * (double)k + o->link->time_tolerance;
    const double *past = o->memory + STEWART_LINK_COMMANDS + 1; /* after the time of the first one */
    for (long i = 0, packet = k - 1; i < o->reported; i++, packet--) {
        arrived[i] = packet >= 0 && o->period * (double)packet + o->transit[packet] <= until;
        stewart_copy(U, past + (1 + U) * i, acted + U * i);
    }
}

/* Send `values` (size) back at sample k; replace them by the newest that arrived in the last period, or
   NaN. Returns their age in periods. */
static int pass_back(const stewart_loop *o, long k, double *values)
{
    const stewart_link *back = o->back;
    const double now = o->period * (double)k, *newest = o->back_memory + STEWART_LINK_COMMANDS;
    const double arrival = now + o->back_transit[k];
    stewart_link_take(back, o->back_memory, now, (double)(k + 1), 0., arrival, 1, values);
    if (stewart_link_next(back, o->back_memory) <= now + back->time_tolerance)
        stewart_link_change(back, o->back_memory, now);
    int arrived = o->back_memory[STEWART_LINK_ACTED] > 0. &&
                  newest[0] > now - o->period + back->time_tolerance;
    for (int i = 0; i < back->size; i++)
        values[i] = arrived ? newest[1 + i] : (double)NAN;
    return arrived ? (int)((double)(k + 1) - o->back_memory[STEWART_LINK_NEWEST]) : 0;
}

/* Measure at sample k, call the controller and send its command. */
static int sample(const dop853 *s, stewart_loop *o, long k, stewart_controller law, void *context)
{
    double *y = o->measured + X * k, *torque = o->asked + U * k, now = o->period * (double)k;
    double *values = o->scratch, *arrived = values + X, *acted = arrived + o->reported;
    double *command = acted + U * o->reported, arrival = now + o->transit[k];
    stewart_report report = {o->reported, arrived, o->reported, acted, 0};
    stewart_sample measured = {.measurement = y};
    for (int i = 0; i < X; i++)
        values[i] = o->noise ? s->x[i] + o->noise[X * k + i] : s->x[i];
    write_report(o, k, arrived, acted);
    if (o->back)
        measured.age = report.age = pass_back(o, k, values);
    stewart_copy(X, values, y);
    if (o->reported && !isnan(arrived[0]))
        measured.report = &report;
    if (law(context, k, &measured, torque, command))
        return STEWART_CONTROLLER_FAILED;
    if (o->servo && k > 0) { /* at k = 0 no setpoint has acted */
        double limited[U];
        DrivenPlant *d = s->system;
        servo_torques(d, s->x, torque, limited);
        o->saturated += d->at_limit;
        d->at_limit = 0;
    }
    if (o->link->is_wire) /* the command acts when it arrives */
        stewart_link_take(o->link, o->memory, now, (double)(k + 1), 0., arrival, 1, command);
    else
        stewart_link_take(o->link, o->memory, now, (double)(k + 1), arrival,
                          ((double)(k - o->repeats) + o->delay) * o->period, o->rows, command);
    o->taken = k + 1;
    return STEWART_INSIDE;
}

/* Advance to `end`, in pieces between which the push begins or ends. */
static int advance_pushed(dop853 *s, stewart_run *r, const stewart_loop *o, double end)
{
    for (;;) {
        const int acts = o->push_from <= s->time && s->time < o->push_to;
        const double change = acts ? o->push_to : s->time < o->push_from ? o->push_from : HUGE_VAL;
        for (int i = 0; i < 6; i++)
            o->wrench[i] = acts ? o->push[i] : 0.;
        const int outcome = advance(s, r, fmin(change, end));
        if (outcome != STEWART_INSIDE || end <= change)
            return outcome;
    }
}

/* Take samples and release torques until the run's end. A change of the torque that coincides with a sample
   takes place after it, at the time of the sample. */
int stewart_closed_loop(stewart_run *r, stewart_loop *o, stewart_controller law, void *context)
{
    DrivenPlant d = {.run = r, .servo = o->servo};
    dop853 s = integrator(&d);
    stewart_copy(U, o->bias, d.bias);
    for (long k = 0;;) {
        hold(&d, stewart_link_current(o->memory));
        double sampled = k < o->samples ? o->sampled[k] : HUGE_VAL;
        double released = stewart_link_next(o->link, o->memory);
        int is_sample = sampled <= released + o->link->time_tolerance, outcome = STEWART_INSIDE;
        double next = is_sample ? sampled : released;
        if (next > r->end)
            return finish(r, &s, advance_pushed(&s, r, o, r->end));
        if (next > s.time + o->link->time_tolerance)
            outcome = advance_pushed(&s, r, o, next);
        if (outcome == STEWART_INSIDE && is_sample)
            outcome = sample(&s, o, k++, law, context);
        else if (outcome == STEWART_INSIDE)
            stewart_link_change(o->link, o->memory, released);
        if (outcome != STEWART_INSIDE)
            return finish(r, &s, outcome);
    }
}

/* The `stewart_controller` of a law. */
static int step_law(void *context, long k, const stewart_sample *measured, double *torque, double *command)
{
    stewart_law_in_loop *in = context;
    const double *sent = torque;
    stewart_sample sample = *measured;
    sample.reference = stewart_planned_rows, sample.goal = stewart_goal_rows;
    sample.context = &in->motion;
    in->motion.now = in->period * (double)k;
    if (in->servos) {
        stewart_fill(U, 0, torque); /* `sample` writes that of the servos */
        stewart_servo_step(in->servos, in->memory, in->scratch, &sample, in->report, command);
        return 0;
    }
    stewart_copy(2, in->weights + 2 * k, sample.weights);
    if (in->tuner) {
        stewart_tuned_step(in->law, in->tuner, in->memory, in->tuner_memory, in->scratch, &sample,
                           in->wanted + X * k, torque);
        stewart_copy(2, sample.weights, in->weights + 2 * k);
        stewart_copy((int)in->columns, in->tuner_memory + 3 + in->columns * (STEWART_WINDOW - 1),
                     in->tuner_rows + in->columns * k);
    } else {
        stewart_step(in->law, in->memory, in->scratch, &sample, torque);
    }
    if (in->law->channel)
        sent = stewart_newest_packet(in->law->packets, in->memory + in->law->layout.channel.at);
    stewart_copy(U * in->rows, sent, command);
    return 0;
}

int stewart_closed_loop_of_law(stewart_run *run, stewart_loop *loop, stewart_law_in_loop *law)
{
    return stewart_closed_loop(run, loop, step_law, law);
}
