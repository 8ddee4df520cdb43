/* Inverse kinematics (crank angles of a pose), its Jacobian, and forward kinematics. */

#pragma once

#include "dynamics.h"
#include "matrix.h"

/* Points: P the plate's origin, and of each leg S the shaft centre, T the crank tip, Q the plate joint;
   p_AB leads from A to B. With q = p_SQ in the motor's frame, crank length u and rod length l, the tip is
   at u [cos(alpha), sin(alpha), 0] from S, and at the distance l from Q:

       A cos(alpha) + B sin(alpha) = C,   A = 2 u q_x,  B = 2 u q_y,  C = q.q + u^2 - l^2,
       alpha = atan2(B, A) + e acos(C / hypot(A, B)),   e = -1 or +1 the crank branch.

   `geometry` has the numbers of a machine (core/layout.py), a pose is roll, pitch, yaw, x, y, z. */

/* Crank angles (6) in rad at a pose (6); NaN where a leg does not reach. */
void stewart_crank_angles(const real *geometry, const real *pose, real *angles);

/* Return whether all legs reach a pose; `strictly`: none of them fully stretched or folded. */
int stewart_within_reach(const real *geometry, const real *pose, int strictly);

/* Return whether a plate at a pose can be regulated: all legs are within reach, none at a dead centre. */
int stewart_is_workable(const real *geometry, const real *pose);

/* J (6, 6), rates of the cranks per rates of the pose. The rod keeps its length, so that

       u rod.tangent alpha_dot = [(p_PQ x rod)' E, rod'] rates,

   rod = p_TQ, tangent = the tip's direction of motion, E the map from rates of roll, pitch and yaw to the
   angular velocity. Returns 0, and J of NaN, where a leg is out of reach or at its dead centre. */
int stewart_crank_jacobian(const real *geometry, const real *pose, real *J);

/* Compute the pose (6) with these crank angles (6); `pose` holds a guess before. Newton's method with halved
   steps on f_i = |p_TQ|^2 / l^2 - 1, which is smooth through dead centres and outside the workspace. A pose
   on the other side of a parallel singularity than the guess is another assembly: then the angles of the
   guess are moved to `angles` in 2, 4, 8, 16 steps. Returns 0 if that finds no pose, or one of another crank
   branch. Scratch: 48 numbers. */
int stewart_forward_kinematics(const real *geometry, const real *angles, real *pose,
                               stewart_scratch scratch);
