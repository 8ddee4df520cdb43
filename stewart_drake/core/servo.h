/* The law for position servos: crank angles of the reference, sent ahead.

   The command computed at t = k dt is reached one period after it arrives, at t + eta + dt:

       command = [alpha(r); J(r) r'; T_ff],    r the reference at t + eta + dt.

   Nothing is fed back across the delay, so that no delay makes the loop unstable. Estimated parameters enter
   T_ff. The observer needs the torques that acted, which depend on the servos' own measurements; the machine
   reports them with each measurement.

   Servos given by their stiffness hold a setpoint for a period instead. Their setpoint is

       alpha(r) + (T_ff + k_v alpha_dot) / k,    r the reference at t + eta + dt / 2,

   within their range and speed; k_v is left out unless T_ff is the inverse dynamics. */

#pragma once

#include "kinematics.h"
#include "law.h"

#define STEWART_COMMAND 18 /* crank angles (rad), their rates (rad/s), torques (N m) */

/* Servos given by their stiffness; k = 0: the other kind. */
typedef struct {
    real stiffness;     /* k, N m/rad */
    real velocity_gain; /* k_v, N m s/rad */
    real low[6], high[6]; /* range of setpoints, rad */
    real most;          /* largest change of a setpoint per period, rad */
} stewart_stiffness;

/* Of `law`, the gain, channel and planner are not used; its `parts` are torques per period of a report. Its
   layout: the last command; observer, state and parameters at the last measurement; its age; and the torque
   of the servos at their last report, before and within the limit. */
typedef struct stewart_servo {
    stewart_law law;
    stewart_stiffness stiff;
    /* Change the command (18) for a row of the reference, before its limits. Returns 0 or the cause of failure.
       NULL: no change. */
    int (*command)(const struct stewart_servo *servo, const real *theta, const real *row, real *command);
    int periods; /* rows of a report; `periods` - 1 reports in a row may be lost without loss of data */
} stewart_servo;

/* Return the size of a report: for each period, the oldest first, the mean torques over equal parts of it
   (parts, 6) and whether one was at the limit; then the last torque before the limit (6). */
int stewart_servo_report(const stewart_servo *servo);

/* Set the memory and layout of `law`. */
void stewart_servo_prepare(stewart_servo *servo);

int stewart_servo_scratch(const stewart_servo *servo);

/* Set the memory before the first sample, with the command (18) that was sent last. */
void stewart_servo_start(const stewart_servo *servo, real *memory, const real *command);

/* Compute the command (18) of a sample; it is finite. `report` came with the measurement, NaN for none. The
   reference is read once, at `eta + dt` or `eta + dt / 2`. Returns the problems, bits of `stewart_status`. */
int stewart_servo_step(const stewart_servo *servo, real *memory, real *scratch,
                       const stewart_sample *sample, const real *report, real *command);
