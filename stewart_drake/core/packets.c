/* Probable torques in flight over a network: see packets.h. */

#include <string.h>

#include "matrix.h"
#include "packets.h"
#include "short.h"

/* Ratio of probabilities above which a torque in flight is replaced. After each replacement the law corrects
   the motion, and after a wrong one it does so twice. */
#define SURE 2
/* Least probability of a late packet, so that no report has the probability 0. */
#define LEAST ((real)1e-9)

/* ---- losses in bursts ---------------------------------------------------------------------------

   The state a of a Markov chain counts the packets since the last burst began, up to `burst`:

       a+ = 0 with probability p, else min(a + 1, burst).

   A packet is lost where a < burst, so that 1 - loss = (1 - p)^burst. */

static real begins(const stewart_packets *p)
{
    return -REAL(expm1)(REAL(log1p)(-p->loss) / (real)p->burst);
}

/* Probability of each state (burst + 1). */
static void stationary(const stewart_packets *p, real *chances)
{
    const real b = begins(p);
    real chance = b;
    for (int a = 0; a < p->burst; a++, chance *= 1 - b)
        chances[a] = chance;
    chances[p->burst] = 1 - p->loss;
}

/* Weights of the states one packet later. */
static void after(const stewart_packets *p, real *chances)
{
    const real b = begins(p), stays = (1 - b) * chances[p->burst];
    real sum = chances[0];
    for (int a = 1; a <= p->burst; a++)
        sum += chances[a];
    for (int a = p->burst; a > 0; a--)
        chances[a] = (1 - b) * chances[a - 1];
    chances[p->burst] += stays;
    chances[0] = b * sum;
}

/* Expectation of a function of the next state, by state. */
static void before(const stewart_packets *p, real *values)
{
    const real b = begins(p), begun = b * values[0];
    for (int a = 0; a <= p->burst; a++)
        values[a] = begun + (1 - b) * values[a < p->burst ? a + 1 : a];
}

/* ---- which packet brings a torque ---------------------------------------------------------------

   The losses are the hidden states of the chain, so that the probabilities of the sources come from
   its forward-backward algorithm. With the evidence E_i on packet i (arrived, or not by the last
   report), older packets give P(state of i | E of older ones) and c_i = P(E_i | the same), the newer
   ones, backwards, P(E and not in time for all newer ones | state of i). Packet i was sent i + 1
   samples ago. */

typedef struct {
    int n;              /* packets that count */
    const real *newest; /* whether the newest has arrived; the older ones lie before it */
    real *not_lost;     /* (n) probability that it is not lost, given the evidence on older ones */
    real *evidence;     /* (n) c_i */
    real *absent;       /* (n) probability that it had not arrived by the report, if it is not lost */
    real *states;       /* (burst + 1) */
} Evidence;

static int has_arrived(const Evidence *c, int i) { return c->newest[-i] > 0; }

static Evidence condition(const stewart_packets *p, int known, const real *arrived, int since, int last,
                          stewart_scratch *scratch)
{
    Evidence c = {known, arrived + known - 1, stewart_take(scratch, known), stewart_take(scratch, known),
                stewart_take(scratch, known), stewart_take(scratch, p->burst + 1)};
    /* An arrived packet ends all bursts: newer packets do not depend on older ones. */
    int relevant = (last + p->torques < known ? last + p->torques : known) - 1;
    for (int i = relevant > 0 ? relevant : 0; i < known; i++)
        if (has_arrived(&c, i)) {
            c.n = i + 1;
            break;
        }
    stationary(p, c.states);
    for (int i = c.n - 1; i >= 0; i--) {
        int age = i + 1 - since; /* of the packet at the last report, periods */
        real sum = 0, absent = 1;
        if (age > 0 && !has_arrived(&c, i) && since < p->num_packets) {
            age = age < p->report_periods ? age : p->report_periods;
            absent = 1 - p->arrived_by[age < p->num_packets ? age : p->num_packets - 1];
        }
        c.absent[i] = absent > LEAST ? absent : LEAST;
        c.not_lost[i] = c.states[p->burst];
        if (has_arrived(&c, i))
            stewart_fill(p->burst, 0, c.states);
        c.states[p->burst] = c.absent[i] * c.not_lost[i];
        for (int a = 0; a <= p->burst; a++)
            sum += c.states[a];
        c.evidence[i] = sum;
        for (int a = 0; a <= p->burst; a++)
            c.states[a] /= sum;
        after(p, c.states);
    }
    return c;
}

/* Probability that packet i, if it is not lost, is not in time for T_{k-1-d} where it has a row for
   it; else that it had not arrived by the report. */
static real lateness(const stewart_packets *p, const Evidence *c, int i, int d)
{
    const int row = i - d + p->repeats, has_row = row >= 0 && row < p->repeats + p->torques;
    const real least = has_arrived(c, i) ? 0 : LEAST;
    real late = c->absent[i];
    if (has_row)
        late = has_arrived(c, i) ? 0 : 1 - p->in_time[row];
    late = late > least ? late : least;
    return late < c->absent[i] ? late : c->absent[i];
}

int stewart_packet_chances(const stewart_packets *p, int known, const real *arrived, int since,
                           int last, int d, real *chances, stewart_scratch scratch)
{
    const Evidence c = condition(p, known, arrived, since, last, &scratch);
    real *newer = c.states, chance = begins(p), none = 0;
    for (int a = 0; a <= p->burst; a++)
        newer[a] = 1;
    for (int i = 0; i < c.n; i++) {
        const real late = lateness(p, &c, i, d), unlost = newer[p->burst];
        chances[i] = unlost * c.not_lost[i] * (c.absent[i] - late) / c.evidence[i];
        for (int a = 0; a < p->burst; a++)
            newer[a] = has_arrived(&c, i) ? 0 : newer[a] / c.evidence[i];
        newer[p->burst] = late / c.evidence[i] * unlost;
        if (i < c.n - 1)
            before(p, newer);
    }
    for (int a = 0; a < p->burst; a++, chance *= 1 - begins(p))
        none += newer[a] * chance;
    chances[c.n] = none + newer[p->burst] * (1 - p->loss);
    return c.n;
}

/* ---- memory ------------------------------------------------------------------------------------- */

static int packet_size(const stewart_packets *p) { return U * (p->repeats + p->torques); }

int stewart_packets_memory(const stewart_packets *p)
{
    return 1 + p->num_packets + p->num_packets * packet_size(p);
}

int stewart_packets_scratch(const stewart_packets *p) { return 4 * p->num_packets + p->burst + 2; }

void stewart_packets_start(const stewart_packets *p, real *memory)
{
    memory[0] = (real)p->num_packets;
    stewart_fill(p->num_packets, 0, memory + 1);
    stewart_fill(p->num_packets * packet_size(p), (real)NAN, memory + 1 + p->num_packets);
}

/* Return the torque that most probably acts as T_{k-1-d}, or NULL for a dry buffer (one without a torque for
   its period). Repeated torques are equal, so that their probabilities add up. The mean over the candidates
   would be worse: the buffer never plays it. */
static const real *expected(const stewart_packets *p, const real *newest, const real *chances, int n,
                            int d)
{
    const int size = packet_size(p), first = d > p->repeats ? d - p->repeats : 0;
    const real *found = newest - size * d + U * p->repeats;
    real best = 0;
    for (int i = first; i <= d; i++)
        best += chances[i];
    best *= SURE;
    for (int i = d + 1; i < d + p->torques && i < n; i++)
        if (chances[i] > best) {
            best = chances[i];
            found = newest - size * i + U * (p->repeats + i - d);
        }
    return chances[n] > best ? NULL : found;
}

/* T_{k-1-d} begins to act mu - 1 - d periods and eta0 from now. With a report that is m periods old,
   all that began before it is known, d >= m + mu. For the others the law assumes the most probable one. */
void stewart_packets_update(const stewart_packets *p, real *memory, const stewart_report *report,
                            int steps, int number, real *in_flight, stewart_scratch scratch)
{
    const int num_packets = p->num_packets, size = packet_size(p);
    real *arrived = memory + 1, *packets = arrived + num_packets, *newest = in_flight + U * (number - 1);
    if (report && report->age < 0)
        report = NULL;
    int since = report ? report->age : (int)memory[0] + 1, known = 0;
    since = since < num_packets ? since : num_packets;
    memory[0] = (real)since;
    for (int i = 0; report && i < report->packets && i + since < num_packets; i++)
        if (report->arrived[i] > 0)
            arrived[num_packets - 1 - i - since] = 1;
    for (int i = 0; report && i < report->periods && i + since + steps < number; i++)
        if (stewart_all_finite(U, report->acted + U * i))
            stewart_copy(U, report->acted + U * i, newest - U * (i + since + steps));
    for (int i = 0; i < num_packets; i++)
        known += !isnan(packets[size * i]);
    int last = since + steps < num_packets ? since + steps : num_packets;
    last = last < number - 1 ? last : number - 1;
    if (!known) /* all torques in flight are from before the first sample */
        return;
    real *chances = stewart_take(&scratch, known + 1);
    for (int d = (last < known ? last : known) - 1; d >= 0; d--) {
        real *flying = newest - U * d;
        const int n = stewart_packet_chances(p, known, arrived + num_packets - known, since, last, d, chances,
                                             scratch);
        const real *torque = expected(p, packets + size * (num_packets - 1), chances, n, d);
        if (torque)
            stewart_copy(U, torque, flying);
        else if (p->holds)
            stewart_copy(U, flying - U, flying);
        else
            stewart_fill(U, 0, flying);
    }
}

const real *stewart_newest_packet(const stewart_packets *p, const real *memory)
{
    return memory + 1 + p->num_packets + packet_size(p) * (p->num_packets - 1);
}

void stewart_packets_send(const stewart_packets *p, real *memory, const real *plan, int number,
                          const real *in_flight)
{
    const int num_packets = p->num_packets, size = packet_size(p), repeated = U * p->repeats;
    real *arrived = memory + 1, *packets = arrived + num_packets, *newest = packets + size * (num_packets - 1);
    const int first = !(newest[0] == newest[0]); /* NaN */
    memmove(arrived, arrived + 1, (size_t)(num_packets - 1) * sizeof(real));
    arrived[num_packets - 1] = 0;
    memmove(packets, packets + size, (size_t)(size * (num_packets - 1)) * sizeof(real));
    if (first)
        stewart_copy(repeated, in_flight + U * (number - p->repeats), newest);
    else if (num_packets > 1) /* the last packet's, which lies before the place of the new one */
        stewart_copy(repeated, newest - size + U, newest);
    else
        memmove(newest, newest + U, (size_t)repeated * sizeof(real));
    stewart_copy(U * p->torques, plan, newest + repeated);
}
