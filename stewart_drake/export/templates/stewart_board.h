/* What stewart_machine.c asks of a machine: write these for your motors and sensors, in place of
   stewart_board.c. Times are in ns of the clock of udp.c, from the start of the program. One loop calls them: while it
   hangs, in one of them too, the last torque acts. Use a hardware watchdog. */

#pragma once

#include "protocol.h"

/* Flags of each datagram. A real machine has at most STEWART_SAFE_HOLDS: its safe torque is the last one, else
   zero. STEWART_SIMULATION: controllers need not be armed. STEWART_RESETS: `board_park` puts the plate back. */
extern const uint32_t board_flags;

/* Put the brakes on; with STEWART_RESETS the plate at its start, too. */
void board_park(void);

/* Take the brakes off. Until the first `board_drive`, apply the safe torque. */
void board_release(uint64_t time);

/* Apply torques (6), N m, within their limits, from now on. */
void board_drive(uint64_t time, const double *torque);

/* Measure pose and rates (12), rad, m, rad/s and m/s, as roll, pitch, yaw, x, y, z; NAN for what is lost. After a
   pause of the loop `time` is long past: all is NAN then, unless it was sampled in time. */
void board_measure(uint64_t time, double *state);

/* Return why the machine must stop (the plate left its workspace, STEWART_DRIVE), and set the time of that;
   else STEWART_NO_FAULT. After a fault the safe torque acts until a new session: put brakes on here. */
stewart_reason board_fault(uint64_t time, uint64_t *left_at);
