/* Paths onto the reference that held torques follow without error, in pieces. A row has 18 numbers: pose,
   rates and accelerations. */

#pragma once

#include "machine.h"

enum {
    STEWART_PIECE = 2 + 2 * 18, /* numbers of a piece: begin and end in s, the row at both */
    STEWART_MOST_HOLDS = 100    /* torques in a plan */
};

/* Return the least distance of the measures of a pose above `least` (8); NaN if a measure is NaN. `sign` is
   that of the parallel measure at home. */
real stewart_margin(const real *geometry, const real *pose, real sign, const real *least);

/* Write the times at which a plan needs the reference: its end, and two nodes of the period after it. */
void stewart_plan_times(real begin, real period, int periods, real times[3]);

/* Number of pieces of a plan over a number of periods, and of its scratch numbers. */
int stewart_plan_pieces(real period, int periods);
int stewart_plan_scratch(real period, int periods);

/* Plan from a state (12) onto the reference, with its rows (3, 18) at `stewart_plan_times`. Returns the
   number of pieces, 0 without a plan; `peak` is the largest torque, `sign` as above. */
int stewart_plan_path(const stewart_model *model, real sign, const real *start, real begin,
                      real period, int periods, const real *rows, real *pieces, real *peak,
                      stewart_scratch scratch);

/* Write the pieces of the motion through `states` (1 + schedule->number, 12) under torques from `begin` s on.
   Returns their number. */
int stewart_predicted_pieces(const stewart_model *model, const stewart_schedule *schedule,
                             const real *states, real begin, real *pieces);

/* Compute the row of a path at a time. Before the first piece its first rates are constant. Returns 0 after
   the last piece. */
int stewart_path_row(int number, const real *pieces, real time, real *row);
