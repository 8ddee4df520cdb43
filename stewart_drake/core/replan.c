/* See replan.h. */

#include "replan.h"
#include "short.h"

#define PIECE STEWART_PIECE

/* Memory: samples since the plan was made, its pieces, how many. Times of pieces are from that sample. */
static int most_pieces(const stewart_law *law)
{
    const stewart_replan *replan = law->planning;
    return replan->until + stewart_plan_pieces(law->period, replan->periods);
}

static int replan_memory(const stewart_law *law) { return 2 + PIECE * most_pieces(law); }

static int replan_scratch(const stewart_law *law)
{
    const stewart_replan *replan = law->planning;
    return X * (replan->until + 1) + PIECE * most_pieces(law) +
           stewart_plan_scratch(law->period, replan->periods);
}

static void replan_start(const stewart_law *law, real *memory)
{
    stewart_fill(replan_memory(law), 0, memory);
}

/* The path, and beyond its end the reference; without a path what the caller follows. */
static void look(const stewart_law *law, const real *memory, const stewart_sample *sample, int number,
                 const real *times, real *rows)
{
    const int pieces = (int)memory[1];
    const real now = memory[0] * law->period;
    for (int i = 0; i < number; i++) {
        real *row = rows + ROW * i;
        if (pieces == 0)
            sample->reference(sample->about, 1, times + i, row);
        else if (!stewart_along(pieces, memory + 2, now + times[i], row))
            sample->goal(sample->about, 1, times + i, row);
    }
}

/* A new path: the predicted motion, through `states`, then a plan back. Returns 0 where there is none. */
static int plan(const stewart_law *law, const stewart_outlook *outlook, const stewart_sample *sample,
                const real *states, real *memory, stewart_scratch scratch)
{
    const stewart_replan *replan = law->planning;
    real times[3], rows[3 * ROW], peak, *pieces = stewart_take(&scratch, PIECE * most_pieces(law));
    const real *last = states + X * outlook->until.number;
    stewart_belief belief;
    stewart_believe(&law->machine, outlook->theta, &belief);
    stewart_plan_times(outlook->eta, law->period, replan->periods, times);
    sample->goal(sample->about, 3, times, rows);
    int number = stewart_predicted_pieces(&belief, &outlook->until, states, 0, pieces);
    int further = stewart_plan_way(&belief, replan->sign, last, outlook->eta, law->period,
                                   replan->periods, rows, pieces + PIECE * number, &peak, scratch);
    if (further == 0)
        return 0;
    memory[0] = 0;
    memory[1] = (real)(number + further);
    stewart_copy(PIECE * (number + further), pieces, memory + 2);
    return 1;
}

static int replan_follow(const stewart_law *law, real *memory, const stewart_outlook *outlook,
                         const stewart_sample *sample, stewart_scratch scratch)
{
    const stewart_replan *replan = law->planning;
    real *states = stewart_take(&scratch, X * (outlook->until.number + 1)), wanted[ROW];
    memory[0] += 1;
    if (!sample->goal || !outlook->settled || !stewart_all_finite(X, outlook->state))
        return 0;
    stewart_copy(X, outlook->state, states);
    stewart_predict(&law->machine, outlook->theta, &outlook->until, states, states + X);
    look(law, memory, sample, 1, &outlook->eta, wanted);
    if (!stewart_is_off(replan->size, states + X * outlook->until.number, wanted, outlook->found))
        return 0;
    return plan(law, outlook, sample, states, memory, scratch);
}

const stewart_planner stewart_replanner = {replan_memory, replan_scratch, replan_start, replan_follow,
                                           look};
