/* Ways of the plate onto its reference that held torques can follow without error, and the pieces of
   which such a way consists. A row has 18 numbers: pose, rates and accelerations. */

#pragma once

#include "machine.h"

enum {
    STEWART_PIECE = 2 + 2 * 18, /* numbers of a piece: begin and end in s, the row at both */
    STEWART_MOST_HOLDS = 100    /* torques in a plan */
};

/* Least distance of the measures of a pose above `least` (8); NaN if one of them is NaN. `sign` is that
   of the parallel measure at home. */
real stewart_margin(const real *geometry, const real *pose, real sign, const real *least);

/* Where a plan that begins at an instant needs the reference: its end, and two nodes of the period
   after it. */
void stewart_plan_times(real begin, real period, int periods, real times[3]);

/* Pieces of a plan over a number of periods, and scratch memory for it. */
int stewart_plan_pieces(real period, int periods);
int stewart_plan_scratch(real period, int periods);

/* Plan from a state (12) onto the reference, with its rows (3, 18) at `stewart_plan_times`. Returns the
   number of pieces, 0 without a plan; `peak` is the largest torque, `sign` that of the parallel measure at
   home. */
int stewart_plan_path(const stewart_model *model, real sign, const real *start, real begin,
                     real period, int periods, const real *rows, real *pieces, real *peak,
                     stewart_scratch scratch);

/* Pieces of the motion through `states` (1 + schedule->number, 12) under torques from `begin` s on;
   their number. */
int stewart_predicted_pieces(const stewart_model *model, const stewart_schedule *schedule,
                             const real *states, real begin, real *pieces);

/* The row of a way at an instant. Before a piece the pose goes on the straight line that its first
   rates continue. Returns 0 after the last piece. */
int stewart_path_row(int number, const real *pieces, real time, real *row);
