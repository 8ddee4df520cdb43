/* The law for position servos: crank angles of the reference, sent ahead.

   The command computed at t = k dt is reached one period after it arrives, at t + eta + dt:

       command = [alpha(r); J(r) r'; T_ff],    r the reference at t + eta + dt.

   Nothing is fed back across the delay, so that no delay makes the loop unstable. What the observer
   finds of the machine goes into T_ff. It needs the torques that acted; these depend on what the servos
   saw, and the machine reports them with the measurement.

   Servos given by their stiffness hold a setpoint for a period instead. Theirs is

       alpha(r) + (T_ff + k_v alpha_dot) / k,    r the reference at t + eta + dt / 2,

   within their range and speed; k_v counts where T_ff is the inverse dynamics. */

#pragma once

#include "kinematics.h"
#include "law.h"

#define STEWART_COMMAND 18 /* crank angles (rad), their rates (rad/s), torques (N m) */

typedef struct {
    stewart_field command;     /* sent last */
    stewart_field observer;    /* at the last measurement */
    stewart_field lag;      /* periods since that was taken */
    stewart_field state;       /* at the last measurement */
    stewart_field parameters;
    stewart_field measurement; /* the last, as it came */
    stewart_field torque;      /* that the servos asked for when they reported last */
    stewart_field in_flight;   /* what their limit let through of it */
    stewart_field counts;
} stewart_servo_layout;

/* Servos given by their stiffness; k = 0 stands for others. */
typedef struct {
    real stiffness;     /* k, N m/rad */
    real velocity_gain; /* k_v, N m s/rad */
    real low[6], high[6]; /* range of setpoints, rad */
    real most;          /* largest change of a setpoint per period, rad */
} stewart_stiffness;

/* `law` has `parts` torques in a report of each period; its cost but the feedforward, channel and what
   a law for torques remembers do not count. */
typedef struct stewart_servo {
    stewart_law law;
    stewart_stiffness stiff;
    /* Change the command (18) for a row of the reference, before its limits, or NULL. Returns 0 or the cause of
       failure. */
    int (*command)(const struct stewart_servo *servo, const real *theta, const real *row, real *command);
    int periods; /* rows of a report; `periods` - 1 reports in a row may be lost without loss of data */
    int memory;  /* numbers of the memory, and the place of each field: `stewart_servo_prepare` */
    stewart_servo_layout layout;
} stewart_servo;

/* Numbers of a report: a row for each period, the oldest first, of the mean torques over equal parts of
   it (parts, 6) and whether one was at the limit; then what was asked for last (6). */
int stewart_servo_report(const stewart_servo *servo);

void stewart_servo_prepare(stewart_servo *servo);

int stewart_servo_scratch(const stewart_servo *servo);

/* Before the first sample, with the command (18) that was sent last. */
void stewart_servo_start(const stewart_servo *servo, real *memory, const real *command);

/* One sample: the command (18) to send, finite. `report` came with the measurement, NaN for none. The
   reference is asked for once, at `eta + dt` or `eta + dt / 2`. Returns what went wrong, bits of `stewart_status`. */
int stewart_servo_step(const stewart_servo *servo, real *memory, real *scratch,
                       const stewart_sample *sample, const real *report, real *command);
