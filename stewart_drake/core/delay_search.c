/* Search for an unknown delay by a Gaussian sum over the first arrival, see delay.h.

   The *master* hypothesis assumes that no torque of the controller has arrived. At t_k a *cell* is copied
   from it, as it was at t_{k-1}, for a first arrival in between: eta uniform in (t_{k-1}, t_k]. With Phi
   the distribution of the prior, the part

       share = [Phi(t_k) - Phi(t_{k-1})] / [1 - Phi(t_{k-1})]

   of the master's weight goes to the cell. Each measurement multiplies all weights by its likelihood. The
   search ends with a cell as the only hypothesis when the standard deviation of its delay is below RESOLUTION,
   and every hypothesis farther than RESOLUTION from it has less than e^-LEAD of its weight.

   Two outliers in a row may be a jump of the delay. State and parameters are known by then, so the last
   measurements are compared with the prediction for every delay of a grid. Hypotheses start from the best
   few; the best of them is accepted if no other explains the measurements about as well. */

#include "delay.h"
#include "short.h"

#define LEAD 7       /* log of the odds that ends the search */
#define FORGOTTEN 14 /* log of the odds that drops a cell */
#define YOUNG 3      /* measurements before which no cell is dropped: a bias may look like another arrival */
#define RESOLUTION ((real)0.2) /* periods; delays that are closer are one hypothesis */
#define LEAST_SHARE ((real)1e-4) /* of the master's weight, for a new cell and for the master itself */
#define SUSPICIOUS 2 /* outliers in a row that start the search for a jump */
#define PATIENCE 3   /* outliers in a row after which the filter restarts */
#define GRID ((real)0.5) /* periods between the delays of the grid after a jump */
#define STARTS 2     /* hypotheses that start from the grid */
#define HOPELESS 100 /* largest cost of the second one, plus ten times the cost of the first */
#define ACCEPTED 5   /* log of the odds at which one of two is accepted */
#define MOST_TO_PLAN 2 /* largest number of cells that leaves time for a plan at the same sample */
#define CAUTION 10   /* factor on the weight of torques during the search */
#define LOOSENED ((real)0.05) /* deviation added to parameters at a restart, over that of the prior */
#define LOOSENED_BY_JUMP ((real)0.01) /* the same at a jump of the delay */
#define FIRST_TORQUES 1 /* number of torques in the initial estimate of the timing. Without it the first late
                           torques would be outliers, and the next ones would change payload and bias. */
#define SQRT_12 ((real)3.4641016151377546)
#define SQRT_2_PI ((real)2.5066282746310005)

/* The search during one sample. */
typedef struct {
    const stewart_delay *delay;
    int n, m, num_in_flight; /* numbers of xi, of a measurement and of torques */
    stewart_period last_period; /* before this sample */
    stewart_delay_memory *memory;
    real *other_torques, *last_measurements; /* in `memory` */
} Search;

/* Number of torques in the memory that act until an own one arrives. */
static int max_others(int num_in_flight) { return num_in_flight > 1 ? num_in_flight - 1 : 1; }

int stewart_delay_size(int p, int m, int num_in_flight)
{
    return STEWART_DELAY_NUMBERS + U * max_others(num_in_flight) + 2 * m
        + (num_in_flight + 1) * stewart_hypothesis_size(p);
}

int stewart_delay_scratch(int p, int m, int num_in_flight)
{
    const int n = X + p + 2, advance = stewart_delay_advance_scratch(p, m, num_in_flight);
    const int compared = n * n + (2 * X + 1 + m) * n + 2 * X * X + (m + 1 + X) * m
        + stewart_period_scratch(p, num_in_flight);
    const int more = advance > 3 * n * n ? advance : 3 * n * n; /* a new start */
    return (STARTS + 1) * stewart_hypothesis_size(p) + (2 + U) * num_in_flight + U
        + (more > compared ? more : compared);
}

stewart_hypothesis *stewart_delay_hypothesis(int p, int m, int num_in_flight, stewart_delay_memory *memory,
                                             int place)
{
    real *first = memory->numbers + U * max_others(num_in_flight) + 2 * m;
    return (stewart_hypothesis *)(first + place * stewart_hypothesis_size(p));
}

static stewart_hypothesis *hypothesis_at(const Search *s, int place)
{
    return stewart_delay_hypothesis(s->n - X - 2, s->m, s->num_in_flight, s->memory, place);
}

static void copy_hypothesis(int n, const stewart_hypothesis *from, stewart_hypothesis *to)
{
    stewart_copy(stewart_hypothesis_size(n - X - 2), (const real *)from, (real *)to);
}

static real distance_of(int n, const stewart_hypothesis *a, const stewart_hypothesis *b)
{
    return REAL(fabs)(a->numbers[STEWART_ETA(n)] - b->numbers[STEWART_ETA(n)]);
}

/* ---- the prior of the delay ------------------------------------------------------------------- */

static real density(real x) { return REAL(exp)(-x * x / 2) / SQRT_2_PI; }

/* Prior probability of a delay longer than t, up to the longest. */
static real left_of_prior(const stewart_delay *d, real t)
{
    const real left = stewart_normal_between((t - d->delay_mean) / d->delay_std,
                                             (d->longest - d->delay_mean) / d->delay_std);
    return left > 0 ? left : 0;
}

/* Mean and standard deviation of the prior between t and the longest delay. With a and b the bounds
   in standard deviations, Z the probability between them, phi the density,

       mean = delay_mean + delay_std r,   variance = delay_std^2 (1 + (a phi(a) - b phi(b)) / Z - r^2),
       r = (phi(a) - phi(b)) / Z. */
static void rest_of_prior(const stewart_delay *d, real t, real *mean, real *std)
{
    const real from = t < d->longest ? t : d->longest;
    const real a = (from - d->delay_mean) / d->delay_std;
    const real b = (d->longest - d->delay_mean) / d->delay_std, Z = stewart_normal_between(a, b);
    if (Z < (real)1e-12) {
        *mean = (from + d->longest) / 2;
        *std = (d->longest - from) / SQRT_12;
        return;
    }
    const real r = (density(a) - density(b)) / Z;
    const real variance = 1 + (a * density(a) - b * density(b)) / Z - r * r;
    *mean = d->delay_mean + d->delay_std * r;
    *std = d->delay_std * REAL(sqrt)(variance > 0 ? variance : 0);
}

/* ---- the search ------------------------------------------------------------------------------- */

/* Add the cell of an arrival within period k. */
static void spawn(Search *s, int k, stewart_scratch scratch)
{
    const stewart_delay *d = s->delay;
    const int n = s->n;
    const real low = (real)(k - 1) * d->period, high = (real)k * d->period;
    const real left = left_of_prior(d, low);
    const real prior_share = left > 0 ? 1 - left_of_prior(d, high) / left : 1;
    const real share = clamped(LEAST_SHARE, prior_share, 1 - LEAST_SHARE);
    real *L = stewart_take(&scratch, n * n);
    s->memory->cells += 1;
    stewart_hypothesis *master = hypothesis_at(s, 0), *cell = hypothesis_at(s, (int)s->memory->cells);
    copy_hypothesis(n, master, cell);
    cell->low = low;
    cell->high = high;
    cell->weight += REAL(log)(share);
    master->weight += REAL(log1p)(-share);
    cell->numbers[STEWART_ETA(n)] = (low + high) / 2;
    cell->numbers[STEWART_RATE(n)] = 0;
    stewart_unpack_root(n, cell->numbers + n, L); /* its last two rows are 0 */
    L[(n + 1) * STEWART_ETA(n)] = d->period / SQRT_12;
    L[(n + 1) * STEWART_RATE(n)] = d->rate_std;
    stewart_hypothesis_set_root(n, L, cell);
}

/* Compute the state (12) from one measurement, and the lower triangular root (12, 12) of its covariance. */
static int start_of(const stewart_sensing *sensing, const real *y, const real *near, real *state,
                    real *root, stewart_scratch scratch)
{
    real W[X * X];
    if (!sensing->start(sensing, y, near, state, W, scratch))
        return 0;
    stewart_transpose(X, W);
    stewart_fill(X * X, 0, root);
    stewart_add_root(X, X, root, W);
    stewart_transpose(X, root);
    return 1;
}

/* Set a hypothesis: state and parameters, each with the root of its covariance, and a delay eta with the
   standard deviation `std`. L (n, n) is scratch. */
static void set_hypothesis(int n, const real *state, const real *state_root, const real *theta,
                           const real *theta_root, real eta, real std, real rate_std, real *L,
                           stewart_hypothesis *hypothesis)
{
    const int p = n - X - 2;
    stewart_copy(X, state, hypothesis->numbers);
    stewart_copy(p, theta, hypothesis->numbers + X);
    hypothesis->numbers[STEWART_ETA(n)] = eta;
    hypothesis->numbers[STEWART_RATE(n)] = 0;
    stewart_fill(n * n, 0, L);
    for (int i = 0; i < X; i++)
        stewart_copy(X, state_root + X * i, L + n * i);
    for (int i = 0; i < p; i++)
        stewart_copy(p, theta_root + p * i, L + n * (X + i) + X);
    L[(n + 1) * STEWART_ETA(n)] = std;
    L[(n + 1) * STEWART_RATE(n)] = rate_std;
    stewart_hypothesis_set_root(n, L, hypothesis);
}

/* Begin from one measurement, with the master and a cell for every period so far. */
static void begin(Search *s, const real *y, const real *near, stewart_scratch scratch)
{
    const stewart_delay *d = s->delay;
    stewart_hypothesis *master = hypothesis_at(s, 0);
    real *L = stewart_take(&scratch, s->n * s->n), root[X * X], state[X];
    if (!start_of(d->filter.sensing, y, near, state, root, scratch))
        return;
    stewart_fill(STEWART_HYPOTHESIS, 0, (real *)master);
    master->high = d->longest;
    master->fits = 1;
    master->timing = d->filter.timing_std * d->filter.timing_std;
    master->torques = FIRST_TORQUES;
    set_hypothesis(s->n, state, root, d->prior, d->filter.prior_root, STEWART_NO_ARRIVAL, 0, 0, L, master);
    s->memory->known = s->memory->searching = 1;
    s->memory->cells = s->memory->best = 0;
    for (int k = 1; k <= s->last_period.view.num_own && (real)(k - 1) * d->period < d->longest; k++)
        spawn(s, k, scratch);
}

/* Advance the hypothesis at a place by one period and a measurement, or NULL. */
static void update(Search *s, int place, const real *y, stewart_scratch scratch)
{
    stewart_hypothesis *hypothesis = hypothesis_at(s, place);
    stewart_hypothesis *after =
        (stewart_hypothesis *)stewart_take(&scratch, stewart_hypothesis_size(s->n - X - 2));
    stewart_delay_advance(&s->last_period, hypothesis, y, after, scratch);
    if (y && s->memory->searching > 0)
        after->weight += after->log_likelihood;
    copy_hypothesis(s->n, after, hypothesis);
}

static real highest_weight(const Search *s)
{
    real highest = hypothesis_at(s, 0)->weight;
    for (int i = 1; i <= (int)s->memory->cells; i++)
        if (hypothesis_at(s, i)->weight > highest)
            highest = hypothesis_at(s, i)->weight;
    return highest;
}

/* Drop unlikely cells, close the gaps that they leave, and set weights relative to the best hypothesis. */
static void drop_unlikely_cells(Search *s)
{
    const real highest = highest_weight(s);
    int best = 0, remaining = 0;
    hypothesis_at(s, 0)->weight -= highest;
    for (int i = 1; i <= (int)s->memory->cells; i++) {
        stewart_hypothesis *cell = hypothesis_at(s, i);
        const int young = cell->measurements <= YOUNG && cell->fits > 0;
        if (!young && !(cell->weight > highest - FORGOTTEN))
            continue;
        cell->weight -= highest;
        remaining++;
        if (remaining < i)
            copy_hypothesis(s->n, cell, hypothesis_at(s, remaining));
        if (hypothesis_at(s, remaining)->weight > hypothesis_at(s, best)->weight)
            best = remaining;
    }
    s->memory->cells = (real)remaining;
    s->memory->best = (real)best;
}

/* Whether the best hypothesis is a cell with a precise delay, and all others are near it or unlikely. */
static int is_found(const Search *s)
{
    const real resolution = RESOLUTION * s->delay->period;
    const int best = (int)s->memory->best;
    const stewart_hypothesis *found = hypothesis_at(s, best);
    real rival = hypothesis_at(s, 0)->weight;
    for (int i = 1; i <= (int)s->memory->cells; i++) {
        const stewart_hypothesis *cell = hypothesis_at(s, i);
        if (distance_of(s->n, cell, found) > resolution && cell->weight > rival)
            rival = cell->weight;
    }
    return best > 0 && found->fits > 0 && rival < -LEAD && stewart_hypothesis_std(found, s->n) < resolution;
}

/* Advance master and cells by a period and a measurement, or NULL; drop unlikely cells; end the search if the
   delay is found. */
static void search(Search *s, const real *y, stewart_scratch scratch)
{
    const stewart_delay *d = s->delay;
    stewart_delay_memory *memory = s->memory;
    const int k = s->last_period.view.num_own;
    if (k < s->num_in_flight && (real)(k - 1) * d->period < d->longest)
        spawn(s, k, scratch);
    const int cells = (int)memory->cells;
    for (int i = 0; i <= cells; i++)
        update(s, i, y, scratch);
    drop_unlikely_cells(s);
    if (!y || !is_found(s))
        return;
    stewart_hypothesis *found = hypothesis_at(s, (int)memory->best);
    found->low = 0;
    found->high = d->longest;
    found->weight = 0;
    copy_hypothesis(s->n, found, hypothesis_at(s, 0));
    memory->searching = memory->cells = memory->best = 0;
    memory->found = 1;
    memory->deferred = cells > MOST_TO_PLAN;
}

/* ---- jumps and new starts --------------------------------------------------------------------- */

/* Begin `hypothesis` from a state (12) with the root of its covariance (12, 12), and a delay eta with the
   standard deviation `std`. Parameters are those of `from`; `loosened` times the standard deviations of the
   prior is added to their uncertainty. */
static void begin_at(const Search *s, const stewart_hypothesis *from, real eta, real std, real loosened,
                     const real *state, const real *root, stewart_hypothesis *hypothesis,
                     stewart_scratch scratch)
{
    const stewart_delay *d = s->delay;
    const int n = s->n, p = n - X - 2;
    real *L = stewart_take(&scratch, n * n), *R = stewart_take(&scratch, p * p);
    real *W = stewart_take(&scratch, (X + p) * p);
    stewart_unpack_root(n, from->numbers + n, L);
    stewart_fill(p * p, 0, R);
    for (int i = 0; i < p; i++)
        R[(p + 1) * i] = loosened * d->std[i];
    for (int i = 0; i < X + p; i++) /* the parameters' rows have columns of the state's, too */
        for (int j = 0; j < p; j++)
            W[p * i + j] = L[n * (X + j) + i];
    stewart_add_root(p, X + p, R, W);
    stewart_transpose(p, R);
    copy_hypothesis(n, from, hypothesis);
    set_hypothesis(n, state, root, from->numbers + X, R, eta, std, d->rate_std, L, hypothesis);
    hypothesis->outliers = 0;
}

/* Add to `cost` (number) the squared distance of the measurement y after a period from its prediction, for
   every delay of the grid. The period begins in a state with the root of its covariance. Returns 0 without a
   prediction. */
static int add_costs(const Search *s, const stewart_period *t, const stewart_hypothesis *hypothesis,
                     const real *state, const real *root, const real *y, int number, real *cost,
                     stewart_scratch scratch)
{
    const stewart_delay *d = s->delay;
    const stewart_sensing *sensing = d->filter.sensing;
    const int n = s->n, m = s->m, known = n - 2;
    real *L = stewart_take(&scratch, n * n), *H = stewart_take(&scratch, X * n);
    real *xi = stewart_take(&scratch, n), *A = stewart_take(&scratch, X * (n + X));
    real *C = stewart_take(&scratch, m * m), end[X];
    stewart_copy(n, hypothesis->numbers, xi);
    stewart_copy(X, state, xi);
    xi[STEWART_RATE(n)] = 0;
    if (!stewart_period_at(t, xi, 0, end, H, scratch))
        return 0;
    stewart_unpack_root(n, hypothesis->numbers + n, L);
    for (int i = 0; i < X; i++) {
        stewart_copy(X, root + X * i, L + n * i);
        stewart_fill(n - X, 0, L + n * i + X);
    }
    /* Columns of the root of the state, then of the parameters, which count as uncorrelated. */
    stewart_fill((known + X) * X, 0, A);
    for (int k = 0; k < known; k++)
        for (int j = 0; j <= k; j++)
            for (int i = 0; i < X; i++)
                A[X * (k < X ? j : X + j) + i] += H[n * i + k] * L[n * k + j];
    if (!stewart_innovation_root(sensing, state, known + X, A, d->filter.model_std, C, scratch))
        return 0;
    for (int k = 0; k < number; k++) {
        xi[STEWART_ETA(n)] = (real)(k + 1) * GRID * d->period;
        if (!stewart_period_misfit(t, xi, y, C, cost + k, scratch))
            return 0;
    }
    return 1;
}

/* Return the place of the lowest local minimum other than `excluded` (-1 for none), or -1. */
static int lowest_minimum(int number, const real *cost, int excluded)
{
    int best = -1;
    for (int i = 0; i < number; i++) {
        const int falls = i == 0 || cost[i] <= cost[i - 1];
        const int rises = i == number - 1 || cost[i] <= cost[i + 1];
        if (i != excluded && falls && rises && isfinite(cost[i]) && (best < 0 || cost[i] < cost[best]))
            best = i;
    }
    return best;
}

/* Begin `tried` at eta, two periods ago, and advance it by the measurements at the ends of the periods. Returns
   the log of their likelihood. */
static real try_delay(const Search *s, const stewart_period *periods, const real *const *measured, real eta,
                      const real *state, const real *root, stewart_hypothesis *tried, stewart_scratch scratch)
{
    const stewart_delay *d = s->delay;
    stewart_hypothesis *after =
        (stewart_hypothesis *)stewart_take(&scratch, stewart_hypothesis_size(s->n - X - 2));
    real total = 0;
    begin_at(s, hypothesis_at(s, 0), eta, d->period / SQRT_12, LOOSENED_BY_JUMP, state, root, tried, scratch);
    tried->low = eta > d->period ? eta - d->period : 0;
    tried->high = eta + d->period < d->longest ? eta + d->period : d->longest;
    for (int i = 0; i < 2; i++) {
        stewart_delay_advance(periods + i, tried, measured[i], after, scratch);
        copy_hypothesis(s->n, after, tried);
        total += after->log_likelihood;
    }
    return total;
}

/* Replace the only hypothesis by one of another delay that explains the last three measurements: two in
   the memory, and y. Returns 0 if there is none. */
static int jump(Search *s, const real *y, stewart_scratch scratch)
{
    const stewart_delay *d = s->delay;
    const int n = s->n, m = s->m, num_others = s->last_period.view.num_others;
    const real resolution = RESOLUTION * d->period;
    const real *measured[3] = {s->last_measurements, s->last_measurements + m, y};
    const int wanted = (int)REAL(ceil)((d->longest / d->period - GRID) / GRID);
    const int number = wanted < 2 * s->num_in_flight ? wanted : 2 * s->num_in_flight;
    stewart_hypothesis *hypothesis = hypothesis_at(s, 0), *tried[STARTS];
    real *cost = stewart_take(&scratch, number), states[2][X], roots[2][X * X], total[STARTS];
    real *others = stewart_take(&scratch, U * (num_others + 1));
    stewart_period periods[2] = {s->last_period, s->last_period};
    if (!stewart_all_finite(2 * m, s->last_measurements) || !stewart_all_finite(m, y))
        return 0;
    stewart_copy(U, s->other_torques, others); /* the torque before the first is unknown: assume the same */
    stewart_copy(U * num_others, s->other_torques, others + U);
    periods[0].view.other_torques = others;
    periods[0].view.num_others++;
    periods[0].newest = 1;
    stewart_fill(number, 0, cost);
    for (int i = 0; i < 2; i++)
        if (!start_of(d->filter.sensing, measured[i], hypothesis->numbers, states[i], roots[i], scratch)
            || !add_costs(s, periods + i, hypothesis, states[i], roots[i], measured[i + 1], number, cost, scratch))
            return 0;
    int tries = 0, lowest = -1;
    for (; tries < STARTS; tries++) {
        const int place = lowest_minimum(number, cost, lowest);
        if (place < 0 || (tries > 0 && !(cost[place] <= HOPELESS + 10 * cost[lowest])))
            break;
        lowest = tries > 0 ? lowest : place;
        tried[tries] = (stewart_hypothesis *)stewart_take(&scratch, stewart_hypothesis_size(n - X - 2));
        total[tries] = try_delay(s, periods, measured + 1, (real)(place + 1) * GRID * d->period, states[0],
                                 roots[0], tried[tries], scratch);
    }
    if (!tries) /* no cost is finite */
        return 0;
    const int has_rival = tries > 1, best = has_rival && total[1] > total[0];
    stewart_hypothesis *found = tried[best];
    if (has_rival && distance_of(n, tried[0], tried[1]) > resolution
        && !(total[best] - total[1 - best] >= ACCEPTED))
        return 0;
    if (!(found->fits > 0) || !(stewart_hypothesis_std(found, n) < resolution)
        || !(distance_of(n, found, hypothesis) > resolution)) /* less than that is not a jump */
        return 0;
    found->low = 0;
    found->high = d->longest;
    found->outliers = 0;
    copy_hypothesis(n, found, hypothesis);
    return 1;
}

/* Restart from the last measurement, after outliers that nothing explains. If they come before most delays of
   the prior have passed, the delay was found wrongly, since friction may look like an arrival: search again. */
static void restart(Search *s, const real *y, const real *near, stewart_scratch scratch)
{
    const stewart_delay *d = s->delay;
    const int n = s->n;
    stewart_hypothesis *hypothesis = hypothesis_at(s, 0);
    stewart_hypothesis *anew = (stewart_hypothesis *)stewart_take(&scratch, stewart_hypothesis_size(n - X - 2));
    real state[X], root[X * X];
    const int early = s->memory->num_own * d->period < d->delay_mean + d->delay_std;
    if (s->memory->searching > 0 || early) {
        begin(s, y, near, scratch);
        return;
    }
    if (!start_of(d->filter.sensing, y, hypothesis->numbers, state, root, scratch))
        return;
    const real std = stewart_hypothesis_std(hypothesis, n), least = d->period / 10;
    begin_at(s, hypothesis, hypothesis->numbers[STEWART_ETA(n)], std > least ? std : least, LOOSENED, state,
             root, anew, scratch);
    anew->numbers[STEWART_RATE(n)] = hypothesis->numbers[STEWART_RATE(n)];
    copy_hypothesis(n, anew, hypothesis);
}

/* ---- one sample ------------------------------------------------------------------------------- */

/* Compute mean and standard deviation of the delay during the search. */
static void set_mixture_moments(Search *s)
{
    stewart_delay_memory *memory = s->memory;
    const int n = s->n, cells = (int)memory->cells;
    const real highest = highest_weight(s);
    real total = 0, sum = 0, squares = 0, master_eta, master_std;
    rest_of_prior(s->delay, memory->num_own * s->delay->period, &master_eta, &master_std);
    for (int i = 0; i <= cells; i++) {
        const stewart_hypothesis *cell = hypothesis_at(s, i);
        const real weight = REAL(exp)(cell->weight - highest);
        total += weight;
        sum += weight * (i > 0 ? cell->numbers[STEWART_ETA(n)] : master_eta);
    }
    memory->mean = sum / total;
    for (int i = 0; i <= cells; i++) {
        const stewart_hypothesis *cell = hypothesis_at(s, i);
        const real error = (i > 0 ? cell->numbers[STEWART_ETA(n)] : master_eta) - memory->mean;
        const real std = i > 0 ? stewart_hypothesis_std(cell, n) : master_std;
        squares += REAL(exp)(cell->weight - highest) * (std * std + error * error);
    }
    memory->std = REAL(sqrt)(squares / total);
}

/* Write the delay for the law, and whether to feed back: not in an open-loop start, nor once the mean of the
   prior has passed without an arrival. */
static void report(Search *s, int measured)
{
    const stewart_delay *d = s->delay;
    stewart_delay_memory *memory = s->memory;
    const stewart_hypothesis *hypothesis = hypothesis_at(s, (int)memory->best);
    const real eta = hypothesis->numbers[STEWART_ETA(s->n)];
    const int settled = !(memory->searching > 0) && !(memory->deferred > 0);
    const int open_loop = memory->open_loop > 0 && !settled, no_arrival = !(eta < STEWART_NO_ARRIVAL);
    memory->rejected = measured && !(hypothesis->fits > 0);
    memory->settled = (real)settled;
    memory->open_loop = (real)open_loop;
    memory->caution = settled ? 1 : CAUTION;
    memory->eta = eta > 0 ? eta : 0;
    memory->rate = hypothesis->numbers[STEWART_RATE(s->n)];
    memory->feeds_back = 1;
    if (!settled && (no_arrival || open_loop)) {
        const int overdue = no_arrival && memory->num_own * d->period >= d->delay_mean;
        memory->feeds_back = !(open_loop || overdue);
        memory->eta = d->delay_mean > 0 ? d->delay_mean : 0;
        memory->rate = 0;
    }
    memory->mean = eta;
    memory->std = stewart_hypothesis_std(hypothesis, s->n);
    if (memory->searching > 0)
        set_mixture_moments(s);
}

void stewart_delay_start(const stewart_delay *d, int num_in_flight, stewart_delay_memory *memory)
{
    const int p = d->filter.machine->estimated, m = d->filter.sensing->size;
    stewart_fill(stewart_delay_size(p, m, num_in_flight), 0, (real *)memory);
    memory->eta = d->delay_mean;
    memory->num_own = -1; /* before the first sample */
    memory->open_loop = d->open_loop_start ? 1 : 0;
    memory->settled = memory->feeds_back = memory->caution = 1;
    memory->mean = memory->std = (real)NAN;
    stewart_fill(2 * m, (real)NAN, memory->numbers + U * max_others(num_in_flight));
}

void stewart_delay_observe(const stewart_delay *d, int num_in_flight, const real *in_flight,
                           const real *y, const real *near, stewart_delay_memory *memory,
                           stewart_scratch scratch)
{
    const int n = X + d->filter.machine->estimated + 2, m = d->filter.sensing->size, first = memory->num_own < 0;
    const int others = max_others(num_in_flight);
    Search s = {.delay = d, .n = n, .m = m, .num_in_flight = num_in_flight, .memory = memory};
    s.other_torques = memory->numbers;
    s.last_measurements = memory->numbers + U * others;
    if (first) /* no own torque in flight yet; without a queue the torque of the last period continues */
        stewart_copy(U * others, in_flight + U * (num_in_flight - others), s.other_torques);
    if (memory->num_own < (real)num_in_flight)
        memory->num_own += 1;
    memory->found = memory->deferred;
    memory->deferred = memory->rejected = 0;
    s.last_period = (stewart_period){d, {d->period, 0, 0, (int)memory->num_own, others, s.other_torques},
                                     num_in_flight, 0, in_flight};
    if (!(memory->known > 0)) {
        if (y)
            begin(&s, y, near, scratch);
    } else if (memory->searching > 0) {
        search(&s, y, scratch);
    } else {
        update(&s, 0, y, scratch);
        if (y && hypothesis_at(&s, 0)->outliers >= SUSPICIOUS && jump(&s, y, scratch))
            memory->deferred = 1;
    }
    if (y && memory->known > 0 && hypothesis_at(&s, (int)memory->best)->outliers >= PATIENCE)
        restart(&s, y, near, scratch);
    stewart_copy(m, s.last_measurements + m, s.last_measurements);
    for (int i = 0; i < m; i++)
        s.last_measurements[m + i] = y ? y[i] : (real)NAN;
    if (!first) { /* move on by a period; the last torque stays */
        for (int i = 0; i < U * (others - 1); i++)
            s.other_torques[i] = s.other_torques[i + U];
    }
    if (memory->known > 0)
        report(&s, y != NULL);
}
