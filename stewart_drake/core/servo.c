#include "servo.h"
#include "short.h"

#define SATURATED 6 /* place among the counts of periods with a servo at its limit */

static int width(const stewart_servo *servo) { return U * servo->law.parts + 1; }

int stewart_servo_report(const stewart_servo *servo) { return servo->periods * width(servo) + U; }

void stewart_servo_prepare(stewart_servo *servo)
{
    stewart_law *law = &servo->law;
    stewart_layout *l = &law->layout;
    law->memory = 0;
    l->command = stewart_place(law, 1, STEWART_COMMAND);
    l->observer = stewart_place(law, 1, law->observer->memory(law));
    l->lag = stewart_place(law, 1, 1);
    l->state = stewart_place(law, 1, X);
    l->parameters = stewart_place(law, 1, law->machine.estimated);
    l->measurement = stewart_place(law, 1, law->num_values);
    l->torque = stewart_place(law, 1, U);
    l->in_flight = stewart_place(law, 1, U);
    l->counts = stewart_place(law, 1, STEWART_CAUSES);
    l->started = stewart_place(law, 1, 1);
}

int stewart_servo_scratch(const stewart_servo *servo)
{
    const stewart_law *law = &servo->law;
    return U * law->parts * servo->periods + U + law->observer->scratch(law);
}

/* Copy state and parameters from the observer. */
static void take_estimate(const stewart_servo *servo, real *memory)
{
    const stewart_law *law = &servo->law;
    const stewart_layout *l = &servo->law.layout;
    real std[STEWART_MAX_ESTIMATED];
    stewart_copy(X, memory + l->observer.at, memory + l->state.at);
    law->observer->parameters(law, memory + l->observer.at, memory + l->parameters.at, std);
}

void stewart_servo_start(const stewart_servo *servo, real *memory, const real *command)
{
    const stewart_layout *l = &servo->law.layout;
    stewart_fill(servo->law.memory, 0, memory);
    stewart_copy(STEWART_COMMAND, command, memory + l->command.at);
    memory[l->started.at] = STEWART_STARTED;
    servo->law.observer->start(&servo->law, memory + l->observer.at);
    stewart_fill(servo->law.num_values, (real)NAN, memory + l->measurement.at);
    take_estimate(servo, memory);
}

/* Read the torques of the last `periods` periods from a report. Returns their number, 0 if it lacks some. */
static int read_report(const stewart_servo *servo, const real *report, int periods, real *torques,
                       int *saturated)
{
    const int columns = width(servo), size = columns - 1;
    const real *rows = report + columns * (servo->periods - periods);
    if (periods > servo->periods || !stewart_all_finite(columns * periods, rows))
        return 0;
    *saturated = 0;
    for (int i = 0; i < periods; i++) {
        stewart_copy(size, rows + columns * i, torques + size * i);
        *saturated += rows[columns * i + size] > 0;
    }
    return servo->law.parts * periods;
}

/* Advance the observer to a measurement, with the reported torques since the one before. Without that
   report the observer restarts. */
static int observe(const stewart_servo *servo, real *memory, const stewart_sample *sample,
                   const real *report, int periods, stewart_scratch scratch)
{
    const stewart_law *law = &servo->law;
    const stewart_layout *l = &servo->law.layout;
    real *torques = stewart_take(&scratch, U * law->parts * servo->periods + U);
    real *observer = memory + l->observer.at;
    int saturated = 0, number = read_report(servo, report, periods, torques, &saturated);
    if (number > 0) {
        const real *asked = report + stewart_servo_report(servo) - U;
        stewart_copy(U, asked, memory + l->torque.at);
        if (saturated > 0) /* one of them is counted by the status */
            stewart_count(saturated - 1, memory + l->counts.at + SATURATED);
    } else {
        if (stewart_all_finite(X, memory + l->state.at))
            law->observer->restart(law, observer);
        stewart_fill(U, 0, torques);
        number = 1;
    }
    int status = law->observer->observe(law, observer, number, torques, sample->measurement, scratch);
    take_estimate(servo, memory);
    return saturated > 0 ? status | STEWART_SATURATED : status;
}

/* Return a setpoint within range and speed, a period after `last`. */
static real limited(const stewart_stiffness *stiff, int i, real setpoint, real last)
{
    const real near = last + REAL(remainder)(setpoint - last, TURN);
    const real within = REAL(fmax)(stiff->low[i], REAL(fmin)(stiff->high[i], near));
    return last + REAL(fmax)(-stiff->most, REAL(fmin)(stiff->most, within - last));
}

/* Compute [crank angles; their rates; torque] for a row of the reference, without limits. Returns 0 or the cause
   of failure. */
static int unlimited(const stewart_servo *servo, const real *theta, const real *row, real *found)
{
    const stewart_law *law = &servo->law;
    static const real zero[12] = {0};
    const int moves = law->cost.feedforward == STEWART_INVERSE_DYNAMICS;
    const real *geometry = law->machine.geometry;
    real J[36];
    stewart_model model;
    stewart_fill(STEWART_COMMAND, 0, found);
    stewart_crank_angles(geometry, row, found);
    if (!stewart_all_finite(6, found) || !stewart_crank_jacobian(geometry, row, J))
        return STEWART_UNREACHABLE;
    stewart_multiply(6, 6, 1, J, row + 6, found + 6);
    stewart_set_model(&law->machine, theta, &model);
    if (law->cost.feedforward != STEWART_NO_FEEDFORWARD)
        stewart_inverse_dynamics(&model.plant, row, moves ? row + 6 : zero,
                                 moves ? row + 12 : zero, found + 12);
    const stewart_stiffness *stiff = &servo->stiff;
    if (stiff->stiffness > 0) /* before the check, so that NaN stops here */
        for (int i = 0; i < U; i++)
            found[i] += (found[12 + i] + (moves ? stiff->velocity_gain * found[6 + i] : 0)) / stiff->stiffness;
    return 0;
}

/* Replace the last command by that for a row of the reference. Returns 0 or the cause of failure. */
static int command_for(const stewart_servo *servo, const real *theta, const real *row, real *command)
{
    const stewart_stiffness *stiff = &servo->stiff;
    real found[STEWART_COMMAND];
    if (!stewart_all_finite(ROW, row))
        return STEWART_REFERENCE_MISSING;
    int failure = unlimited(servo, theta, row, found);
    if (!failure && servo->command)
        failure = servo->command(servo, theta, row, found);
    if (failure)
        return failure;
    if (!stewart_all_finite(STEWART_COMMAND, found))
        return STEWART_NONFINITE_TORQUE;
    if (stiff->stiffness > 0)
        for (int i = 0; i < U; i++)
            found[i] = limited(stiff, i, found[i], command[i]);
    stewart_copy(STEWART_COMMAND, found, command);
    return 0;
}

int stewart_servo_step(const stewart_servo *servo, real *memory, real *scratch_memory,
                       const stewart_sample *sample, const real *report, real *command)
{
    const stewart_law *law = &servo->law;
    const stewart_layout *l = &servo->law.layout;
    const stewart_scratch scratch = {scratch_memory};
    if (memory[l->started.at] != STEWART_STARTED) {
        stewart_fill(STEWART_COMMAND, 0, command);
        return STEWART_NOT_STARTED;
    }
    const real ahead = servo->stiff.stiffness > 0 ? (real)0.5 : 1;
    const real time = ((real)law->steps + law->fraction + ahead) * law->period;
    const int lag = (int)memory[l->lag.at] + 1;
    real row[ROW], *last = memory + l->command.at;
    int there = 0, status = STEWART_MEASUREMENT_MISSING;
    for (int i = 0; i < law->num_values; i++)
        there |= isfinite(sample->measurement[i]) != 0;
    if (there && sample->age >= 0 && sample->age < lag)
        status = observe(servo, memory, sample, report, lag - sample->age, scratch);
    else
        there = 0;
    memory[l->lag.at] = (real)(there ? sample->age : lag);
    sample->reference(sample->context, 1, &time, row);
    int failure = command_for(servo, memory + l->parameters.at, row, last);
    if (failure) /* the cranks stop where they are */
        stewart_fill(6, 0, last + 6);
    stewart_copy(STEWART_COMMAND, last, command);
    stewart_copy(law->num_values, sample->measurement, memory + l->measurement.at);
    stewart_limit(&law->machine, memory + l->torque.at, memory + l->in_flight.at);
    status |= failure;
    for (int i = 0; i < STEWART_CAUSES; i++)
        stewart_count(status >> i & 1, memory + l->counts.at + i);
    return status;
}
