#include "replan.h"
#include "short.h"

/* Places in the memory. */
enum {
    SINCE_PLAN,  /* samples since the last plan, or without one since the start */
    PIECES,      /* number of pieces */
    SINCE_START, /* samples since the start */
    PLANNED,     /* whether a plan was made after the first torque had acted for a period */
    PATH,        /* first number of the pieces; their times are from the sample of the plan */
};
#define EARLY ((real)0.5) /* part of the assumed delay before which no torque arrives */
#define MOST_CAUTION 2 /* factor on the weight of torques above which no plan is made */
#define MOST_SAMPLES ((real)1e6) /* largest count of samples since the start */
/* Error of a prediction, over the motion, above which a plan is made: when the delay was just found, and else. */
#define OFF_WHEN_FOUND ((real)0.02)
#define OFF ((real)0.08)
#define ROUNDING ((real)1e-3) /* samples; a time nearer to a sample than this is at the sample */

static int most_pieces(const stewart_law *law)
{
    const stewart_replan *replan = law->planning;
    return replan->until + stewart_plan_pieces(law->period, replan->most);
}

static int replan_memory(const stewart_law *law) { return PATH + STEWART_PIECE * most_pieces(law); }

static int replan_scratch(const stewart_law *law)
{
    const stewart_replan *replan = law->planning;
    const int p = law->machine.estimated;
    const int judged = (X + p) * (X + p + X + 1) + stewart_transitions_scratch(p);
    const int planned = STEWART_PIECE * most_pieces(law) + stewart_plan_scratch(law->period, replan->most);
    return X * (replan->until + 1) + (judged > planned ? judged : planned);
}

static void replan_start(const stewart_law *law, real *memory)
{
    stewart_fill(replan_memory(law), 0, memory);
}

/* Whether the first torque has acted for a period. */
static int has_acted(const stewart_law *law, const stewart_outlook *outlook, const real *memory)
{
    return memory[SINCE_START] >= outlook->eta / law->period + 2 - ROUNDING;
}

/* Compute the rows of the plan, before and after it of the goal; without a plan those of the caller's
   reference. Without torques in flight a hold's change begins before the plan. */
static void rows_of(const stewart_law *law, const real *memory, const stewart_sample *sample, int number,
                    const real *times, real *rows)
{
    const int pieces = (int)memory[PIECES];
    const real now = memory[SINCE_PLAN] * law->period;
    if (pieces == 0)
        sample->reference(sample->context, number, times, rows);
    for (int i = 0; i < number && pieces > 0; i++) {
        real *row = rows + ROW * i;
        const int before = now + times[i] < memory[PATH] - ROUNDING * law->period;
        if (before || !stewart_path_row(pieces, memory + PATH, now + times[i], row))
            (sample->goal ? sample->goal : sample->reference)(sample->context, 1, times + i, row);
    }
}

/* Plan: pieces of the predicted motion through `states`, then of the path onto the goal. Returns 0 without a
   plan. */
static int plan(const stewart_law *law, const stewart_outlook *outlook, const stewart_sample *sample,
                const real *states, real *memory, stewart_scratch scratch)
{
    const stewart_replan *replan = law->planning;
    int periods = replan->periods, added;
    real times[3], rows[3 * ROW], peak, *pieces = stewart_take(&scratch, STEWART_PIECE * most_pieces(law));
    const real *last = states + X * outlook->until_next.number;
    stewart_model model;
    stewart_set_model(&law->machine, outlook->theta, &model);
    const int number = stewart_predicted_pieces(&model, &outlook->until_next, states, 0, pieces);
    for (;; periods = 2 * periods < replan->most ? 2 * periods : replan->most) {
        stewart_plan_times(outlook->eta, law->period, periods, times);
        sample->goal(sample->context, 3, times, rows);
        added = stewart_plan_path(&model, replan->sign, last, outlook->eta, law->period, periods, rows,
                                   pieces + STEWART_PIECE * number, &peak, scratch);
        if (added == 0)
            return 0;
        if (peak <= law->machine.torque_limit)
            break;
        if (periods >= replan->most)
            return 0;
    }
    memory[SINCE_PLAN] = 0;
    memory[PIECES] = (real)(number + added);
    memory[PLANNED] = (real)has_acted(law, outlook, memory);
    stewart_copy(STEWART_PIECE * (number + added), pieces, memory + PATH);
    return 1;
}

/* Whether every standard deviation of the pose after a schedule is at most `sure` times `size` (6), for the
   root L of the covariance of [state; theta] before it, along `states` (1 + number, 12). */
static int is_sure(const stewart_machine *machine, const stewart_schedule *schedule, const real *states,
                   const real *theta, const real *L, const real *size, real sure, stewart_scratch scratch)
{
    const int p = machine->estimated, n = X + p;
    real *H = stewart_take(&scratch, X * n), *xi = stewart_take(&scratch, n);
    if (schedule->number == 0)
        return 1;
    stewart_copy(X, states, xi);
    stewart_copy(p, theta, xi + X);
    if (!stewart_transitions(machine, xi, schedule, 0, states + X, 0, H, scratch))
        return 0;
    for (int i = 0; i < 6; i++) {
        real variance = 0;
        for (int j = 0; j < n; j++) {
            real part = 0; /* (H L)_ij */
            for (int k = 0; k < n; k++)
                part += H[n * i + k] * L[n * k + j];
            variance += part * part;
        }
        if (!(REAL(sqrt)(variance) <= sure * size[i])) /* or NaN */
            return 0;
    }
    return 1;
}

/* Whether a predicted state (12) is so far off the wanted one that a plan is made; `found`: whether the delay
   was found at this sample. */
static int is_off(const real *size, const real *state, const real *wanted, int found)
{
    real most = 0;
    for (int i = 0; i < X; i++) {
        const real away = REAL(fabs)(state[i] - wanted[i]) / size[i % 6];
        if (isnan(away))
            return 0;
        most = away > most ? away : most;
    }
    return most > (found ? OFF_WHEN_FOUND : OFF);
}

static int replan_follow(const stewart_law *law, real *memory, const stewart_outlook *outlook,
                         const stewart_sample *sample, stewart_scratch scratch)
{
    const stewart_replan *replan = law->planning;
    real wanted[ROW], low[X], *states = outlook->predicted;
    if (!states)
        states = stewart_take(&scratch, X * (outlook->until_next.number + 1));
    memory[SINCE_PLAN] += 1;
    memory[SINCE_START] = memory[SINCE_START] < MOST_SAMPLES ? memory[SINCE_START] + 1 : MOST_SAMPLES;
    /* While the delay is unknown, plan only before the first torque can have acted. */
    const int before_first = (memory[SINCE_START] - ROUNDING) * law->period <= EARLY * outlook->eta;
    if (!sample->goal || !(outlook->settled || before_first) || !stewart_all_finite(X, outlook->state))
        return 0;
    /* Torques of uncertain timing do not follow a plan. */
    if (outlook->settled && outlook->caution > MOST_CAUTION)
        return 0;
    stewart_copy(X, outlook->state, states);
    stewart_copy(X, outlook->low, low);
    stewart_predict(&law->machine, outlook->theta, &outlook->until_next, states, low, states + X);
    rows_of(law, memory, sample, 1, &outlook->eta, wanted);
    /* A known delay counts as found from the sample at which the first torque has acted for a period
       until the next plan. */
    const int first = outlook->assumed && has_acted(law, outlook, memory) && !(memory[PLANNED] > 0);
    if (!is_off(replan->size, states + X * outlook->until_next.number, wanted, outlook->found || first))
        return 0;
    if (law->observer->uncertainty) {
        const int n = X + law->machine.estimated;
        stewart_scratch rest = scratch;
        real *L = stewart_take(&rest, n * n);
        law->observer->uncertainty(law, outlook->observed, L);
        if (!is_sure(&law->machine, &outlook->until_next, states, outlook->theta, L, replan->size,
                     replan->sure, rest))
            return 0;
    }
    return plan(law, outlook, sample, states, memory, scratch);
}

const stewart_planner stewart_replanner = {replan_memory, replan_scratch, replan_start, replan_follow,
                                           rows_of};
