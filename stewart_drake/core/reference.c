#include "kinematics.h"
#include "reference.h"
#include "short.h"

#define FURTHER ((real)1.25) /* factor on the distance to rest at which a continued motion is within reach */
#define DOUBLINGS 6          /* of the rate of coming to rest, at the most */
#define CATCH_UP ((real)0.3) /* s, duration of a blend */
#define ROUNDING ((real)1e-4) /* periods; times nearer than this are the same */

void stewart_between(const real *from, const real *to, real h, real s, real *row)
{
    for (int i = 0; i < 6; i++) {
        real v0 = h * from[6 + i], v1 = h * to[6 + i], a0 = h * h * from[12 + i];
        real a1 = h * h * to[12 + i], c2 = a0 / 2, d = to[i] - from[i] - v0 - c2, e = v1 - v0 - a0;
        real f = a1 - a0, c3 = 10 * d - 4 * e + f / 2, c4 = -15 * d + 7 * e - f;
        real c5 = 6 * d - 3 * e + f / 2;
        row[i] = from[i] + s * (v0 + s * (c2 + s * (c3 + s * (c4 + s * c5))));
        row[6 + i] = (v0 + s * (2 * c2 + s * (3 * c3 + s * (4 * c4 + s * 5 * c5)))) / h;
        row[12 + i] = (2 * c2 + s * (6 * c3 + s * (12 * c4 + s * 20 * c5))) / (h * h);
    }
}

/* Continue a row of the reference to `later` s after it (negative: before). The motion decays to rest at the
   rate w: da/dt = -2 w a - w^2 v, with accelerations a and rates v. The rest is (2 v + a / w) / w away; w is
   doubled until FURTHER times that is within reach. With b = a + w v:  v(t) = (v + b t) exp(-w t). */
static void continued(const real *geometry, const real *from, real later, real w, real *row)
{
    for (int doubled = 0; doubled < DOUBLINGS; doubled++, w *= 2) {
        real pose[6];
        for (int i = 0; i < 6; i++)
            pose[i] = from[i] + FURTHER * (2 * from[6 + i] + from[12 + i] / w) / w;
        if (!geometry || stewart_is_workable(geometry, pose))
            break;
    }
    real left = REAL(exp)(-w * later);
    for (int i = 0; i < 6; i++) {
        real v = from[6 + i], a = from[12 + i], b = a + w * v;
        row[i] = from[i] + (v * (1 - left) + b / w * (1 - left * (1 + w * later))) / w;
        row[6 + i] = left * (v + b * later);
        row[12 + i] = left * (a - w * b * later);
    }
}

/* Compute accelerations from rates v and the rows before and after, `later` s away, unless one of them is
   nearer than `closest`:  (v1 - v) / h = (a + a1) / 2. */
static void slopes(const real *const next[2], const real later[2], const real *v, real closest,
                   real *accelerations)
{
    int sides = 0;
    real sum[6] = {0};
    for (int side = 0; side < 2; side++)
        if (next[side] && REAL(fabs)(later[side]) < closest)
            return;
        else if (next[side] && ++sides)
            for (int i = 0; i < 6; i++)
                sum[i] += 2 * (next[side][6 + i] - v[i]) / later[side] - next[side][12 + i];
    for (int i = 0; i < 6; i++)
        accelerations[i] = sum[i] / (real)sides;
}

/* Complete rows next to a time, and by how much they are later. */
typedef struct {
    const real *next[2]; /* before and after, or NULL */
    real later[2];
} Neighbours;

/* Replace a neighbour by a complete row that is nearer. */
static void consider(Neighbours *n, real later, const real *row)
{
    const int side = later > 0;
    if ((side ? later < n->later[1] : later > n->later[0]) && stewart_all_finite(ROW, row)) {
        n->next[side] = row;
        n->later[side] = later;
    }
}

/* Write `rows`: the given reference with its missing numbers filled in. Rows before `since` s count as
   missing. The neighbours in time, of this preview or of the last one (a period earlier), are
   interpolated; a single one is continued to rest. Without a complete row numbers stay missing.
   `eta`: s until the next torque acts; `geometry` NULL: any pose is within reach. */
static void complete(const real *geometry, real period, real eta, const stewart_preview *given,
                     real since, const stewart_preview *last, real *rows)
{
    real found[ROW];
    for (int i = 0; i < given->number; i++)
        if (given->times[i] < since)
            stewart_fill(ROW, (real)NAN, rows + ROW * i);
        else
            stewart_copy(ROW, given->rows + ROW * i, rows + ROW * i);
    for (int i = 0; i < given->number; i++) {
        real *row = rows + ROW * i;
        if (stewart_all_finite(ROW, row))
            continue;
        Neighbours n = {{NULL, NULL}, {-(real)HUGE_VAL, (real)HUGE_VAL}};
        for (int j = 0; j < given->number; j++)
            if (given->times[j] >= since)
                consider(&n, given->times[j] - given->times[i], given->rows + ROW * j);
        for (int j = 1; j < last->number; j++)
            consider(&n, last->times[j] - given->times[i] - period, last->rows + ROW * j);
        const real *const *next = n.next;
        const real *later = n.later;
        const real near = ROUNDING * period; /* previews repeat times but for rounding */
        const real *same = -later[0] < near ? next[0] : later[1] < near ? next[1] : NULL;
        if (same)
            stewart_copy(ROW, same, found);
        else if (next[0] && next[1])
            stewart_between(next[0], next[1], later[1] - later[0], later[0] / (later[0] - later[1]),
                            found);
        else if (next[0] || next[1])
            continued(geometry, next[!next[0]], -later[!next[0]], 2 / (eta + period), found);
        else
            return;
        if (stewart_all_finite(6, row + 6) && !same)
            slopes(next, later, row + 6, period / 20, found + 12);
        for (int k = 0; k < ROW; k++)
            if (!isfinite(row[k]))
                row[k] = found[k];
    }
}

/* Interpolate at a time between the rows before and after it. */
static void interpolate(const stewart_preview *reference, real time, real *row)
{
    int before = 0, after = 0;
    real earlier = -(real)HUGE_VAL, later = (real)HUGE_VAL;
    for (int i = 0; i < reference->number; i++) {
        real gap = reference->times[i] - time;
        if (gap <= 0 && gap > earlier) {
            earlier = gap;
            before = i;
        } else if (gap > 0 && gap < later) {
            later = gap;
            after = i;
        }
    }
    stewart_between(reference->rows + ROW * before, reference->rows + ROW * after, later - earlier,
                    earlier / (earlier - later), row);
}

/* The offset d = [pose; rates] is zero after n holds of h seconds with accelerations a_i, constant
   because torques are held, if

       0 = d_pose + n h d_rates + h^2 sum (n - i - 1/2) a_i,      0 = d_rates + h sum a_i.

   The solution with the least sum of a_i^2 is linear in i: with c_i = (n - 1)/2 - i, sum c_i = 0 and
   sum c_i^2 = n (n^2 - 1)/12,

       a_i = -d_rates / (n h) - 12 (d_pose + n h d_rates / 2) c_i / (h^2 n (n^2 - 1)).

   After the first hold the rest of these accelerations solves the remaining problem: d and n suffice as
   memory. */
static void move_offset(stewart_blend *blend, real h, real time, real *accelerations)
{
    const real n = (real)blend->holds;
    for (int i = 0; i < 6; i++) {
        real *pose = blend->offset + i, *rate = pose + 6, a = -*rate / (n * h);
        if (blend->holds > 1)
            a -= 6 * (*pose + n * h / 2 * *rate) / (h * h * n * (n + 1));
        *pose += time * (*rate + time / 2 * a);
        *rate += time * a;
        accelerations[i] = a;
    }
}

void stewart_begin_blend(const real *offset, real period, int queue, stewart_blend *blend)
{
    int holds = (int)REAL(ceil)(CATCH_UP / period - (real)1e-6);
    stewart_copy(X, offset, blend->offset);
    blend->holds = holds > 2 ? holds : 2;
    blend->samples = queue + 2;
}

void stewart_advance_blend(stewart_blend *blend, real period)
{
    real a[6];
    if (blend->holds > 0) {
        move_offset(blend, period, period, a);
        blend->holds--;
    } else if (blend->samples > 0) {
        blend->samples--;
    }
}

void stewart_add_offset(stewart_blend blend, real period, real time, real *row)
{
    real a[6];
    for (; blend.holds > 0 && time > period; blend.holds--, time -= period)
        move_offset(&blend, period, period, a);
    if (blend.holds == 0)
        return;
    move_offset(&blend, period, time, a);
    for (int i = 0; i < X; i++)
        row[i] += blend.offset[i];
    for (int i = 0; i < 6; i++)
        row[X + i] += a[i];
}

/* Compute the rows of the predicted motion, and the state (12) where the next torque acts. */
static void predicted_rows(const stewart_course_input *m, const stewart_course *c, real *rows, real *state,
                           stewart_scratch scratch)
{
    const stewart_schedule *until = &m->until;
    real *states = stewart_take(&scratch, X * (until->number + 1)), ends[2][ROW], begin = 0;
    stewart_model model;
    stewart_set_model(m->machine, m->theta, &model);
    stewart_copy(X, m->state, states);
    stewart_predict(m->machine, m->theta, until, states, NULL, states + X);
    stewart_copy(X, states + X * until->number, state);
    for (int i = 0; i < c->number; i++) {
        stewart_copy(X, state, rows + ROW * i);
        stewart_fill(6, 0, rows + ROW * i + X);
    }
    for (int k = 0; k < until->number; k++) {
        const real h = until->durations[k], *torque = until->torques + U * k;
        for (int end = 0; end < 2; end++) {
            stewart_copy(X, states + X * (k + end), ends[end]);
            stewart_accelerate(&model, ends[end], torque, ends[end] + X);
        }
        for (int i = 0; i < c->number; i++)
            if (c->times[i] >= begin && c->times[i] < begin + h)
                stewart_between(ends[0], ends[1], h, (c->times[i] - begin) / h, rows + ROW * i);
        begin += h;
    }
}

/* Follow a blend, which begins now if a gap has ended. */
static void return_after_gap(const stewart_course_input *m, const stewart_course *last, int ended,
                             const real *geometry, stewart_course *c, stewart_scratch scratch)
{
    const real h = m->period, eta = m->eta, acts = eta - (real)1e-6 * h;
    real *before = stewart_take(&scratch, ROW * c->number), wanted[ROW], reached[ROW] = {0};
    stewart_blend *blend = &c->blend;
    const stewart_preview reference = {c->number, c->times, c->reference};
    const stewart_preview given_before = {last->number, last->times, last->reference};
    const stewart_preview followed_before = {last->number, last->times, last->followed};
    const int known =
        last->number > 0 && stewart_all_finite(ROW, last->followed + ROW * (last->number - 1));
    const int early = ended || 2 * (real)blend->holds * h >= CATCH_UP;
    const int predicted = !known || (early && !c->missing && m->open_loop);
    if (!predicted) {
        complete(geometry, h, eta, &reference, acts, &followed_before, before);
        if (ended) { /* without a step in what is followed */
            real *continued = stewart_take(&scratch, ROW * c->number);
            const stewart_preview went_on = {c->number, c->times, continued};
            stewart_add_offset(*blend, h, 0, reached);
            complete(geometry, h, eta, &reference, (real)HUGE_VAL, &given_before, continued);
            interpolate(&went_on, eta, wanted);
            for (int i = 0; i < X; i++)
                reached[i] += wanted[i];
        }
    } else if (stewart_all_finite(X, m->state)) {
        predicted_rows(m, c, before, reached, scratch);
    } else { /* nothing else to go on with */
        blend->holds = blend->samples = 0;
        return;
    }
    if (ended || predicted) {
        interpolate(&reference, eta, wanted);
        for (int i = 0; i < X; i++)
            reached[i] -= wanted[i];
        if (ended || !known)
            stewart_begin_blend(reached, h, m->queue, blend);
        else
            stewart_copy(X, reached, blend->offset);
    }
    for (int i = 0; i < c->number; i++) {
        real *row = c->followed + ROW * i;
        if (c->times[i] < acts)
            stewart_copy(ROW, before + ROW * i, row);
        else
            stewart_add_offset(*blend, h, c->times[i] - eta, row);
    }
}

void stewart_follow(const stewart_course_input *m, const stewart_course *last, const real *given,
                    stewart_course *c, stewart_scratch scratch)
{
    const real *geometry = m->machine->acceleration_per_torque ? NULL : m->machine->geometry;
    const stewart_preview now = {c->number, c->times, given};
    const stewart_preview before = {last->number, last->times, last->reference};
    complete(geometry, m->period, m->eta, &now, -(real)HUGE_VAL, &before, c->reference);
    stewart_copy(ROW * c->number, c->reference, c->followed);
    c->missing = !stewart_all_finite(ROW * c->number, given);
    c->gap = !stewart_all_finite(ROW, given + ROW * (c->number - 1));
    c->blend = last->blend;
    stewart_advance_blend(&c->blend, m->period);
    const int ended = last->gap && !c->gap;
    if (ended || c->blend.holds + c->blend.samples > 0)
        return_after_gap(m, last, ended, geometry, c, scratch);
}
