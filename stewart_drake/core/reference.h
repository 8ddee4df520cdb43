/* Interpolation of the reference, its completion over gaps, and the blend back onto it after a gap.
   A row has 18 numbers: pose, rates and accelerations. */

#pragma once

#include "design.h"

/* A reference at some times, s from a sample. */
typedef struct {
    int number;
    const real *times; /* (number) */
    const real *rows;  /* (number, 18) */
} stewart_preview;

/* Offset from the reference that is zero after some holds; and further samples at which torques of
   the blend are in flight. */
typedef struct {
    real offset[STEWART_STATES];
    int holds, samples;
} stewart_blend;

/* Interpolate at s in [0, 1] between two rows h seconds apart, by the polynomial of fifth order. */
void stewart_between(const real *from, const real *to, real h, real s, real *row);

/* Begin a blend from an offset, with `queue` torques in flight. */
void stewart_begin_blend(const real *offset, real period, int queue, stewart_blend *blend);

/* Advance by one hold. */
void stewart_advance_blend(stewart_blend *blend, real period);

/* Add the offset at `time` s from the beginning to a row. */
void stewart_add_offset(stewart_blend blend, real period, real time, real *row);

/* The preview of a sample, and the rows that are followed. */
typedef struct {
    int number;
    real *times, *reference, *followed; /* (number), (number, 18); missing numbers are filled in */
    int missing; /* whether any number was missing */
    int gap;     /* whether the last row was incomplete */
    stewart_blend blend;
} stewart_course;

/* The motion of the plate until the next torque acts. */
typedef struct {
    const stewart_machine *machine;
    real period;
    int queue;               /* torques in flight */
    real eta;                /* s until the next torque acts */
    const real *state;       /* (12) now, NaN if unknown */
    const real *theta;       /* estimated parameters */
    stewart_schedule until;  /* torques that act until then */
    int open_loop;           /* whether nothing is fed back yet */
} stewart_course_input;

/* Fill in a course, with `number` and `times` set, from the rows `given` at its times and the course of
   the last sample. After a gap in the reference a blend leads back onto it. Until the next torque acts,
   the course is that of the last sample; at the first preview, and as long as nothing is fed back, it is
   the predicted motion. Scratch: 2 * 18 numbers for each row, and 12 for each torque of `until` and one. */
void stewart_follow(const stewart_course_input *motion, const stewart_course *last, const real *given,
                    stewart_course *course, stewart_scratch scratch);
