/* The controller behind a socket, as an example: it drives a machine that speaks docs/protocol.md.

       ./stewart_udp ADDRESS PORT [seconds=S] [key=FILE] [log=FILE] [arm]

   It asks for a session, measures the link, chooses when to begin, and then steps the controller once a
   period of the machine{% if wait %}, with the newest measurement{% else %}: when the measurement of the sample is there, or is taken as lost{% endif %}.
   It ends after STEWART_LONGEST_GAP without a usable measurement. Without a key it talks to this computer only; a machine
   that does not say that it is a simulation is driven with `arm` only. The log has a row per sample; `age`
   is the number of periods before the sample at which the measurement was taken. An old log is replaced once a
   machine has answered. */

#define _POSIX_C_SOURCE 200809L

#include <arpa/inet.h>
#include <errno.h>
#include <limits.h>
#include <math.h>
#include <stdio.h>
#include <string.h>

#include "stewart_config.h"
#include "stewart_example.h"
#include "udp.h"

#define USAGE                                                                                      \
    "stewart_udp ADDRESS PORT [seconds=S] [key=FILE] [log=FILE] [arm], the address in numbers, "   \
    "beyond 127.0.0.1 with a key"
#define RECENT 128 /* datagrams by which the link is judged */
#define AT_ONCE 256 /* datagrams that are read without a look at the clock */
#define ENOUGH 50  /* round trips before the begin */
#define REQUEST_PERIOD (SECOND / 50) /* ns between two requests */
#define KEPT @kept@u  /* number of the last samples that are kept, a power of two */
#define FURTHEST 4096 /* samples that a measurement may be ahead */
#define SPARE (SECOND / 500) /* ns of waiting for a measurement beyond the usual time */
/* Longest wait for a step, in multiples of `longest`: from step to step the period and the usual lateness, which are
   each within `longest`, and one more for SPARE. It limits the wait if the times of a machine are wrong. */
#define MOST_LONGEST 3
{% if network %}
#define OFF 8 /* torques in a row that are reported a period early or late */
{% else %}
#define REPEATS @0 if servos else 7@ /* earlier rows that a datagram repeats, against losses */
#define PLANNED @15 if servos else 8@ /* later rows of a datagram, against later losses */
{% endif %}
/* Periods for which a late measurement is of use. */
#define LONGEST_WAIT @"((int)KEPT - 1)" if servos else wait@
#define PATIENCE (10ull * SECOND) /* for an answer, and for the begin, ns */
#define LONGEST_GAP ((uint64_t)(STEWART_LONGEST_GAP * SECOND)) /* ns */
#define CONTENT @"STEWART_CRANKS" if servos else "STEWART_TORQUES"@
#define DESIGN stewart_configuration@".law" if servos@
#define LAW (&c->law@".law" if servos@)

/* Times of the last datagrams, ns of the own clock. */
typedef struct {
    double trip[RECENT];  /* there and back */
    double there[RECENT]; /* offset of the machine's clock */
    double phase[RECENT]; /* arrival, less the time of the measurement */
    double rate;          /* of the machine's clock */
    unsigned number;
} link_times;

/* A measurement, by its sample. */
typedef struct {
    int there, measured; /* whether a datagram is there, and a measurement in it */
    unsigned sample;
    double values[STEWART_MEASUREMENT_SIZE];
} kept_measurement;

typedef struct {
    int socket;
    struct sockaddr_in machine;
    stewart_key key;
    stewart_session session;
    int offered, busy, other_version; /* what a machine has answered */
    uint64_t nonce;                   /* of its last offer, 0 if another controller drives it */
    stewart_identity identity;        /* of the machine */
    link_times times;
    double longest;        /* ns by which a measurement may be late and still count as usual */
    stewart_measured last; /* the newest datagram */
    uint64_t begin, period; /* ns of the machine's clock */
    kept_measurement came[KEPT];
    unsigned next; /* the first sample whose measurement was not used */
    struct {
        int period;
        real torque[STEWART_MOTORS];
    } acted[KEPT];
{% if network %}
    struct {
        uint32_t sequence;
        int arrived;
    } packets[KEPT];
    int checked, off[2]; /* newest report of torques, and how many in a row were a period early or late */
{% endif %}
    int buffered; /* whether the machine has a play-out buffer */
    uint32_t flags;
    unsigned refused[STEWART_REFUSALS];
    @"stewart_servo" if servos else "stewart_law"@ law; /* within the machine's torque limit */
    real memory[STEWART_MEMORY], scratch[STEWART_SCRATCH], measured[STEWART_MEASUREMENT_SIZE];
{% if network %}
    real arrived[KEPT], told[KEPT][STEWART_MOTORS];
    stewart_report report; /* of these */
{% else %}
    real ahead[STEWART_MEMORY], nothing[STEWART_MEASUREMENT_SIZE]; /* for plans: a copy, and NaN */
{% endif %}
{% if tuner %}
    real tuner[STEWART_TUNER_MEMORY];
{% endif %}
    stewart_plan plan;
    unsigned samples, missing, missed;
    unsigned unusable, causes[3]; /* measurements in a row; those missing, frozen, rejected */
    double seconds;
    const char *log_name;
    FILE *log;
} controller;

/* ---------------------------------------------------------------- times */

/* A time, ns, of a number that a datagram may have made huge. */
static uint64_t whole(double time)
{
    return time > 0 ? time < 9e18 ? (uint64_t)time : STEWART_NEVER : 0;
}

static void note_times(link_times *t, const stewart_measured *m, uint64_t now)
{
    const stewart_head *h = &m->head;
    if (h->acknowledged == 0)
        return;
    unsigned i = t->number++ % RECENT;
    t->rate = m->rate;
    t->trip[i] = (double)now - (double)h->echo - (double)h->held / m->rate;
    t->there[i] = (double)h->time + m->rate * fmax(0, t->trip[i]) / 2 - m->rate * (double)now;
    t->phase[i] = (double)now - (double)m->sampled / m->rate;
}

static unsigned number_of(const link_times *t)
{
    return t->number < RECENT ? t->number : RECENT;
}

/* The place of the least value. */
static unsigned least(const link_times *t, const double *values)
{
    unsigned best = 0;
    for (unsigned i = 1; i < number_of(t); i++)
        best = values[i] < values[best] ? i : best;
    return best;
}

static double shortest_trip(const link_times *t)
{
    return t->trip[least(t, t->trip)];
}

static double longest_trip(const link_times *t)
{
    double longest = 0;
    for (unsigned i = 0; i < number_of(t); i++)
        longest = fmax(longest, t->trip[i]);
    return longest;
}

static double machine_time(const link_times *t, uint64_t own)
{
    return t->rate * (double)own + t->there[least(t, t->trip)];
}

/* The own clock when the step of a sample begins at the latest. */
static uint64_t latest(const controller *c, uint64_t sampled)
{
    const link_times *t = &c->times;
{% if wait %}
    return whole(((double)sampled - t->there[least(t, t->trip)]) / t->rate);
{% else %}
    double soonest = t->phase[least(t, t->phase)], late = 0;
    for (unsigned i = 0; i < number_of(t); i++)
        if (t->phase[i] - soonest <= c->longest)
            late = fmax(late, t->phase[i] - soonest);
    return whole(soonest + (double)sampled / t->rate + late + SPARE);
{% endif %}
}

/* From a sample to its torque, ns. */
static uint64_t eta(const controller *c)
{
    return whole((LAW->steps + (double)LAW->fraction) * (double)c->period + 0.5);
}

/* The own clock at which the torque of a sample must be at the machine: when it acts, or, without a
   play-out buffer, before the next step. */
static double acts(const controller *c, uint64_t sampled)
{
    const link_times *t = &c->times;
    if (!c->buffered)
        return (double)latest(c, sampled + c->period);
    return ((double)(sampled + eta(c)) - t->there[least(t, t->trip)]) / t->rate;
}

/* ---------------------------------------------------------------- datagrams */
{% if network %}

/* Whether a packet had this torque for the period. */
static int was_sent(const controller *c, int period, const real *torque)
{
    const stewart_packets *p = LAW->packets;
    const int rows = p->repeats + p->torques;
    const real *packet = stewart_newest_packet(p, c->memory + LAW->layout.channel.at);
    int row = period - LAW->steps - (int)c->samples + 1 + p->repeats; /* of the newest packet */
    for (int i = 0; i < p->num_packets; i++, row++, packet -= rows * STEWART_MOTORS)
        if (row >= 0 && row < rows &&
            memcmp(packet + row * STEWART_MOTORS, torque, STEWART_MOTORS * sizeof *torque) == 0)
            return 1;
    return 0;
}

/* Count the torques that are reported a period early or late. */
static void check(controller *c, int period, const real *torque)
{
    if (period <= c->checked)
        return;
    c->checked = period;
    for (int late = 0; late < 2; late++) {
        int off = !was_sent(c, period, torque) && was_sent(c, period + (late ? -1 : 1), torque);
        c->off[late] = off ? c->off[late] + 1 : 0;
    }
}
{% endif %}

/* Note the reports of a datagram: torques that have acted@" and packets that have arrived" if network@. */
static void note_reports(controller *c, const stewart_measured *m)
{
    double since = ((double)m->acted_from - (double)c->begin) / (double)c->period;
    double newest = floor(since - (double)LAW->fraction + 0.5);
{% if network %}
    for (unsigned i = 0; i < KEPT; i++) {
        uint32_t behind = m->head.acknowledged - c->packets[i].sequence;
        if (c->packets[i].sequence && behind < 64 && m->arrived >> behind & 1)
            c->packets[i].arrived = 1;
    }
{% endif %}
    if (m->begin != c->begin || m->content != CONTENT || !(fabs(newest) < 1e9))
        return;
    for (int row = m->history - 1; row >= 0; row--) {
        int period = (int)newest - row;
        unsigned place = (unsigned)period % KEPT;
        if (period < c->acted[place].period)
            continue;
        c->acted[place].period = period;
        for (int i = 0; i < STEWART_MOTORS; i++)
            c->acted[place].torque[i] = (real)m->acted[row][i];
{% if network %}
        check(c, period, c->acted[place].torque);
{% endif %}
    }
}

/* Keep a measurement until its sample; return why it is refused, or STEWART_TAKEN. */
static int keep(controller *c, const stewart_measured *m)
{
    double values[STEWART_VALUES];
    int number = stewart_values(m, values);
    const int farewell = m->reason.fault == STEWART_ENDED; /* its measurement is of no sample */
    if (c->period == 0 || m->begin != c->begin || m->sampled < m->begin || farewell)
        return STEWART_TAKEN;
    uint64_t sample = (m->sampled - m->begin + c->period / 2) / c->period;
    if ((number && number != STEWART_MEASUREMENT_SIZE) || sample > c->samples + FURTHEST)
        return STEWART_MALFORMED;
    kept_measurement *kept = &c->came[sample % KEPT];
    if (LONGEST_WAIT == 0 && sample < c->samples)
        return STEWART_LATE;
    if (kept->there && kept->sample >= sample)
        return STEWART_TAKEN;
    *kept = (kept_measurement){.there = 1, .measured = number > 0, .sample = (unsigned)sample};
    memcpy(kept->values, values, (size_t)number * sizeof values[0]);
    return STEWART_TAKEN;
}

static void receive(controller *c)
{
    uint8_t data[STEWART_LONGEST + 1];
    struct sockaddr_in from;
    stewart_measured m;
    size_t size;
    for (int i = 0; i < AT_ONCE && udp_get(c->socket, data, &size, &from); i++) {
        uint64_t now = udp_now();
        int cause = stewart_read_measured(data, size, c->key, &m);
        if (cause == STEWART_VERSION && udp_same(&from, &c->machine))
            c->other_version = data[4];
        if (!cause && !udp_same(&from, &c->machine))
            cause = STEWART_FOREIGN;
        if (!cause)
            cause = stewart_note(&c->session, &m.head, now);
        c->refused[cause]++;
        if (cause)
            continue;
        if (m.kind == STEWART_OFFER) {
            c->offered = 1;
            c->busy = (m.head.flags & STEWART_BUSY) != 0;
            c->identity = m.identity;
            c->nonce = c->busy ? 0 : m.head.nonce;
        }
        note_times(&c->times, &m, now);
        note_reports(c, &m);
        c->refused[keep(c, &m)]++;
        if (m.head.sequence >= c->last.head.sequence)
            c->last = m;
    }
}

/* Send the first rows of `plan`; the first one acts at `playout`. */
static void say(controller *c, uint32_t flags, uint64_t sampled, uint64_t playout, unsigned rows)
{
    uint8_t data[STEWART_LONGEST];
    stewart_plan *plan = &c->plan;
    plan->head = stewart_next(&c->session, udp_now(), c->flags | flags);
    plan->head.nonce = c->session.nonce ? c->session.nonce : c->nonce;
    plan->sampled = sampled;
    plan->playout = playout;
    plan->begin = c->begin;
    plan->content = c->session.nonce ? CONTENT : STEWART_REQUEST;
    plan->identity = stewart_own_identity;
    plan->rows = (uint8_t)rows;
    udp_put(c->socket, data, stewart_write_plan(plan, c->key, data), &c->machine);
}

/* ---------------------------------------------------------------- the law */

/* Take the newest measurement up to sample k into `measured`, NaN without any. Return its age in periods@", or that
   of the newest datagram, which a report is of; negative without one" if network@. */
static int take(controller *c, unsigned k)
{
    int age = @"-1" if network else "0"@, found = 0;
    for (int i = 0; i < STEWART_MEASUREMENT_SIZE; i++)
        c->measured[i] = (real)NAN;
    for (int a = 0; !found && a <= LONGEST_WAIT && (unsigned)a + c->next <= k; a++) {
        const kept_measurement *kept = &c->came[(k - (unsigned)a) % KEPT];
        if (!kept->there || kept->sample != k - (unsigned)a)
            continue;
        found = kept->measured;
        for (int i = 0; found && i < STEWART_MEASUREMENT_SIZE; i++)
            c->measured[i] = (real)kept->values[i];
{% if network %}
        age = age < 0 || found ? a : age;
{% else %}
        age = found ? a : age;
{% endif %}
    }
    c->next = found ? k - (unsigned)age + 1 : c->next;
    c->missing += !found;
    return age;
}
{% if network %}

/* Report of packets and torques up to `age` periods before sample k. */
static const stewart_report *report_at(controller *c, unsigned k, int age)
{
    stewart_report *report = &c->report;
    *report = (stewart_report){0, c->arrived, 0, c->told[0], age};
    for (int i = 0; i < LAW->packets->report_periods; i++) {
        int before = (int)k - age - 1 - i;
        unsigned place = (unsigned)before % KEPT;
        c->arrived[report->packets++] = before >= 0 && c->packets[place].arrived;
        if (report->periods == i && c->acted[place].period == before)
            memcpy(c->told[report->periods++], c->acted[place].torque, sizeof c->told[0]);
    }
    return report;
}
{% elif not servos %}

/* Correct the memory by the reported torques, which differ from the sent ones if these came late. */
static void correct(controller *c, unsigned k)
{
    for (int ago = 1; ago <= LAW->layout.in_flight.rows; ago++) {
        int period = (int)k - ago + LAW->steps;
        unsigned place = (unsigned)period % KEPT;
        if (c->acted[place].period == period)
            stewart_note_acted(LAW, c->memory, ago, 1, c->acted[place].torque);
    }
}
{% endif %}

/* Step a memory of the law at sample k. */
static int compute(controller *c, real *memory, unsigned k, stewart_sample *sample)
{
    double now = 1e-9 * k * (double)stewart_period;
    real output[@"STEWART_COMMAND" if servos else "STEWART_MOTORS"@];
    sample->reference = stewart_look_ahead;
    sample->goal = stewart_look_back;
    sample->context = &now;
{% if servos %}
    real report[@steps[0].report.size@]; /* of torques, which the protocol does not have */
    for (int i = 0; i < @steps[0].report.size@; i++)
        report[i] = (real)NAN;
    return stewart_servo_step(&c->law, memory, c->scratch, sample, report, output);
{% elif tuner %}
    real wanted[STEWART_REFERENCE];
    stewart_goal(now, wanted);
    memcpy(sample->weights, memory + LAW->layout.weights.at, sizeof sample->weights);
    return memory == c->memory ? stewart_tuned_step(LAW, &stewart_own_tuner, memory, c->tuner, c->scratch,
                                                    sample, wanted, output)
                               : stewart_step(LAW, memory, c->scratch, sample, output);
{% else %}
    memcpy(sample->weights, stewart_weights, sizeof sample->weights);
    return stewart_step(LAW, memory, c->scratch, sample, output);
{% endif %}
}

/* The row that was computed last; earlier ones @"and planned ones are next to it" if network else "precede it"@. */
static const real *newest_row(const controller *c, const real *memory)
{
{% if network %}
    const stewart_packets *p = LAW->packets;
    return stewart_newest_packet(p, memory + LAW->layout.channel.at) + p->repeats * STEWART_MOTORS;
{% elif servos %}
    return memory + LAW->layout.command.at;
{% else %}
    const stewart_field *in_flight = &LAW->layout.in_flight;
    return memory + in_flight->at + (in_flight->rows - 1) * STEWART_MOTORS;
{% endif %}
}

static void put_row(controller *c, unsigned row, const real *values)
{
    for (int i = 0; i < STEWART_MOTORS; i++)
        c->plan.torques[row][i] = (double)values[i];
}

/* Fill in the rows of sample k, after those of `repeats` earlier ones; return their number. */
static unsigned fill_plan(controller *c, unsigned k, unsigned repeats)
{
    const real *now = newest_row(c, c->memory) - repeats * STEWART_MOTORS;
    unsigned rows = 0, last = repeats@" + (unsigned)LAW->packets->torques - 1" if network@;
    for (; rows <= last; rows++)
        put_row(c, rows, now + rows * STEWART_MOTORS);
{% if network %}
    (void)k;
{% else %}
    if (!c->buffered)
        return rows;
    /* Step a copy of the memory without further measurements. */
    memcpy(c->ahead, c->memory, sizeof c->ahead);
    for (unsigned i = 1; i <= PLANNED; i++) {
        stewart_sample nothing = {.measurement = c->nothing};
{% if servos %}
        if (compute(c, c->ahead, k + i, &nothing) & STEWART_UNREACHABLE)
            break;
{% else %}
        compute(c, c->ahead, k + i, &nothing);
{% endif %}
        put_row(c, rows++, newest_row(c, c->ahead));
    }
{% endif %}
    return rows;
}

/* ---------------------------------------------------------------- the log */

static void note_head(const controller *c)
{
    fprintf(c->log, "time[s]");
{% if encoders %}
    for (int i = 0; i < STEWART_MOTORS; i++)
        fprintf(c->log, ",@"crank" if servos else "angle"@_%d[rad]", i + 1);
{% else %}
    static const char *const names[] = {"roll", "pitch", "yaw", "x", "y", "z"};
    for (int i = 0; i < 6; i++)
        fprintf(c->log, ",%s[%s]", names[i], i < 3 ? "rad" : "m");
    for (int i = 0; i < 6; i++)
        fprintf(c->log, ",%s_dot[%s/s]", names[i], i < 3 ? "rad" : "m");
{% endif %}
    for (int i = 0; i < STEWART_MOTORS; i++)
        fprintf(c->log, ",@"setpoint_%d[rad]" if servos else "torque_%d[N m]"@", i + 1);
    fprintf(c->log, ",age[periods]\n");
}

/* Replace an old log, if there is to be one; return why not, or NULL. */
static const char *begin_log(controller *c)
{
    if (c->log && !(c->log = freopen(c->log_name, "w", c->log)))
        return "the log cannot be written any more";
    if (c->log)
        note_head(c);
    return NULL;
}

/* Write a row: the values at the sample, and what was sent. */
static void note(const controller *c, double t, int age)
{
    const real *sent = newest_row(c, c->memory);
    fprintf(c->log, "%.9g", t);
    for (int i = @"STEWART_MEASUREMENT_SIZE - STEWART_MOTORS" if encoders else "0"@; i < STEWART_MEASUREMENT_SIZE; i++)
        fprintf(c->log, ",%.17g", (double)c->measured[i]);
    for (int i = 0; i < STEWART_MOTORS; i++)
        fprintf(c->log, ",%.17g", (double)sent[i]);
    fprintf(c->log, ",%d\n", age);
}

/* ---------------------------------------------------------------- a sample */

/* Count measurements in a row that the law did not use, not even in part. */
static void judge(controller *c, int status)
{
    const int unusable = stewart_unmeasured(status);
    c->unusable = unusable ? c->unusable + 1 : 0;
    for (int i = 0; i < 3; i++)
        c->causes[i] = unusable ? c->causes[i] + (status >> (STEWART_CAUSES_AT + i) & 1) : 0;
}

static void step(controller *c, unsigned k)
{
    uint64_t sampled = c->begin + k * c->period;
    stewart_sample sample = {.measurement = c->measured, .age = take(c, k)};
    LAW->machine.torque_limit = (real)fmin(c->last.torque_limit, (double)DESIGN.machine.torque_limit);
{% if network %}
    unsigned repeats = (unsigned)LAW->packets->repeats;
    sample.report = sample.age < 0 ? NULL : report_at(c, k, sample.age);
{% elif servos %}
    unsigned repeats = 0;
{% else %}
    /* Only torques of future periods are repeated. */
    unsigned steps = (unsigned)LAW->steps, repeats = steps < k ? steps : k;
    repeats = !c->buffered ? 0 : repeats < REPEATS ? repeats : REPEATS;
    if (c->buffered)
        correct(c, k);
{% endif %}
    judge(c, compute(c, c->memory, k, &sample));
{% if network %}
    c->packets[k % KEPT].sequence = c->session.sent + 1;
    c->packets[k % KEPT].arrived = 0;
{% endif %}
    unsigned rows = fill_plan(c, k, repeats);
    say(c, 0, sampled, sampled + eta(c) - repeats * c->period, rows);
    if (c->log)
        note(c, 1e-9 * k * (double)stewart_period, sample.age);
    c->samples++;
    c->missed += (double)udp_now() > acts(c, sampled);
}

/* ---------------------------------------------------------------- a run */

/* Return why a machine is not driven, or NULL. */
static const char *objection(const controller *c)
{
    static char text[UDP_DIFFERING];
    if (c->other_version) {
        snprintf(text, sizeof text, "the machine speaks protocol version %d; expected %d",
                 c->other_version, STEWART_PROTOCOL);
        return text;
    }
    if (!c->offered)
        return NULL;
    if (stewart_differing(&stewart_own_identity, &c->identity)) {
        udp_differing(&c->identity, &stewart_own_identity, text);
        return text;
    }
    if (c->last.period != stewart_period) {
        snprintf(text, sizeof text, "the machine's datagrams say a period of %g s; expected %g s",
                 1e-9 * (double)c->last.period, 1e-9 * (double)stewart_period);
        return text;
    }
{% if network %}
    if (!c->buffered)
        return "the machine has no play-out buffer, which packets need: export with link.kind: wire";
{% elif finds_delay %}
    if (c->buffered)
        return "the machine keeps to play-out times, so that its delay is known: export with "
               "controller.delay_estimator: none";
{% endif %}
    if (!(c->last.head.flags & STEWART_SIMULATION) && !(c->flags & STEWART_ARMED))
        return "this is a real machine: say `arm` to drive it";
    return NULL;
}

static const char *in_use(const controller *c)
{
    static char text[160];
    char address[INET_ADDRSTRLEN];
    inet_ntop(AF_INET, &c->machine.sin_addr, address, sizeof address);
    snprintf(text, sizeof text,
             "machine at %s:%u is in use by another controller (retry %g s after it stops)", address,
             ntohs(c->machine.sin_port), 1e-9 * (double)c->last.watchdog);
    return text;
}

/* Return why the run does not go on, or NULL. */
static const char *fault(const controller *c)
{
    static char text[200];
    const stewart_measured *m = &c->last;
    const uint64_t gap = c->unusable * c->period;
    size_t used = 0;
    if (m->head.flags & STEWART_LEFT)
        used = (size_t)snprintf(text, sizeof text, "left workspace: ");
    if (used || m->reason.fault == STEWART_ENDED) {
        udp_reason(&m->reason, &m->before, text + used, sizeof text - used);
        return text;
    }
{% if network %}
    for (int late = 0; late < 2; late++)
        if (c->off[late] >= OFF) {
            snprintf(text, sizeof text,
                     "acted_from in the machine's datagrams is one period %s: its last %d rows of torques "
                     "were sent for the period %s", late ? "late" : "early", OFF, late ? "before" : "after");
            return text;
        }
{% endif %}
    if (gap <= LONGEST_GAP)
        return NULL;
    if (c->times.rate * (double)(udp_now() - c->session.heard) >= (double)(gap - c->period))
        return "the machine has fallen silent";
    snprintf(text, sizeof text, "no usable measurement for %g s (%u missing, %u frozen, %u rejected)",
             1e-9 * (double)gap, c->causes[0], c->causes[1], c->causes[2]);
    return text;
}

/* Agree on a session and a begin; return why not, or NULL. */
static const char *greet(controller *c)
{
    uint64_t patience = udp_now() + PATIENCE;
    int told = 0;
    while (c->last.begin == STEWART_NEVER || c->begin == STEWART_NEVER || c->period == 0) {
        if (udp_interrupted() || udp_now() > patience)
            return c->busy ? in_use(c)
                           : "the machine does not answer: expected a running one at this address, with the "
                             "same key=FILE";
        say(c, 0, 0, 0, 0);
        uint64_t next = udp_now() + REQUEST_PERIOD;
        while (udp_now() < next) {
            udp_wait(c->socket, next);
            receive(c);
        }
        if (c->busy && !told) {
            printf("waiting: %s\n", in_use(c));
            fflush(stdout);
            told = 1;
        }
        c->buffered = !(c->last.head.flags & STEWART_WIRE);
        const char *problem = objection(c);
        if (problem)
            return problem;
        c->period = c->offered ? c->last.period : 0;
        if (c->session.nonce == 0 && c->nonce && c->times.number >= ENOUGH) {
            c->session.nonce = c->nonce;
            double ahead = 5 * (double)c->period + 2 * c->times.rate * shortest_trip(&c->times);
            c->begin = (whole(machine_time(&c->times, udp_now()) + ahead) / c->period + 1) * c->period;
        }
    }
    c->begin = c->last.begin; /* as the machine says */
    double jitter = longest_trip(&c->times) - shortest_trip(&c->times);
    c->longest = fmax((double)c->period / c->times.rate, c->buffered ? 1.25 * jitter : 0);
    return NULL;
}

/* Print a warning if the link is too slow for this controller. */
static void warn_of_link(const controller *c)
{
    double trip = shortest_trip(&c->times);
    if (c->buffered && trip > (double)eta(c))
        printf("warning: a round trip takes %.3g ms, but @"setpoints" if servos else "torques"@ are to act %.3g ms after their sample: they "
               "are late; export with a longer delay (@"link.playout" if network else "delay.steps"@)\n", 1e-6 * trip, 1e-6 * (double)eta(c));
}

/* Run all samples; return why the run ended early, or NULL. */
static const char *drive(controller *c)
{
    unsigned number = (unsigned)(1e9 * c->seconds / (double)stewart_period + 0.5);
    uint64_t t = latest(c, c->begin);
    if (t > udp_now() + PATIENCE)
        return "the machine begins too late";
    while (udp_now() + SECOND / 20 < t && !udp_interrupted()) {
        say(c, 0, 0, 0, 0); /* still here */
        udp_wait(c->socket, udp_now() + SECOND / 20);
        receive(c);
    }
    for (unsigned k = 0; k < number; k++) {
        uint64_t sampled = c->begin + k * c->period;
        uint64_t until = latest(c, sampled), furthest = udp_now() + whole(MOST_LONGEST * c->longest);
        until = until < furthest ? until : furthest;
{% if wait %}
        for (receive(c); udp_now() < until && !udp_interrupted(); receive(c))
            udp_wait(c->socket, until);
{% else %}
        /* A measurement later than usual is lost once the next one is there, or once half of the time
           has passed in which the torque can still leave. */
        const kept_measurement *kept = &c->came[k % KEPT];
        double left = acts(c, sampled) - longest_trip(&c->times) - (double)until;
        uint64_t last = c->buffered ? until + whole(left / 2) : until;
        for (receive(c); udp_now() < last && !udp_interrupted(); receive(c)) {
            int usual = udp_now() < until;
            if ((kept->there && kept->sample == k) || (!usual && c->last.sampled > sampled))
                break;
            udp_wait(c->socket, usual ? until : last);
        }
{% endif %}
        if (udp_interrupted())
            return "interrupted";
        const char *problem = fault(c);
        if (problem)
            return problem;
        step(c, k);
    }
    return NULL;
}

/* Read the command line; prints an error and returns 0 if it is wrong. */
static int understood(controller *c, int argc, char **argv)
{
    int usable = argc > 2 && inet_pton(AF_INET, argv[1], &c->machine.sin_addr) == 1;
    double port = usable ? udp_number("PORT", argv[2], UDP_LAST_PORT, 0) : 0;
    c->machine.sin_family = AF_INET;
    c->machine.sin_port = htons((uint16_t)port);
    c->seconds = stewart_duration;
    if (usable && port == 0)
        return 0;
    for (int i = 3; usable && i < argc; i++) {
        const char *text = argv[i];
        if (strncmp(text, "seconds=", 8) == 0) {
            if (!(c->seconds = udp_number("seconds", text + 8, UDP_LONGEST, 1)))
                return 0;
        } else if (strncmp(text, "key=", 4) == 0) {
            if (!(c->key = udp_key(text + 4)).size)
                return 0;
        } else if (strncmp(text, "log=", 4) == 0) {
            c->log_name = text + 4;
        } else if (strcmp(text, "arm") == 0) {
            c->flags = STEWART_ARMED;
        } else {
            usable = 0;
        }
    }
    if (!usable || !(c->key.size || ntohl(c->machine.sin_addr.s_addr) >> 24 == 127)) {
        fprintf(stderr, "expected: " USAGE "\n");
        return 0;
    }
    /* To append, for now: `begin_log` replaces an old log. */
    if (c->log_name && !(c->log = fopen(c->log_name, "a"))) {
        fprintf(stderr, "log=%s: %s\n", c->log_name, strerror(errno));
        return 0;
    }
    return 1;
}

int main(int argc, char **argv)
{
    static controller c;
    if (udp_help(argc, argv, USAGE))
        return 0;
    if (!understood(&c, argc, argv))
        return 2;
    udp_interrupted();
    c.socket = udp_open(0, c.key);
    if (!udp_draw(&c.session.number, sizeof c.session.number))
        return 2;
    c.session.number += c.session.number == 0;
    c.begin = c.last.begin = STEWART_NEVER;
    c.law = stewart_configuration;
{% if servos %}
    stewart_servo_start(&c.law, c.memory, stewart_queue);
{% else %}
    stewart_start(&c.law, c.memory, stewart_queue_rows, stewart_queue);
{% endif %}
{% if tuner %}
    stewart_tuner_start(&stewart_own_tuner, c.tuner);
{% endif %}
{% if network %}
    c.checked = -1;
{% else %}
    for (int i = 0; i < STEWART_MEASUREMENT_SIZE; i++)
        c.nothing[i] = (real)NAN;
{% endif %}
    for (unsigned i = 0; i < KEPT; i++)
        c.acted[i].period = INT_MIN;
    const char *problem = c.socket < 0 ? "no socket" : greet(&c);
{% if not servos %}
    if (!(c.last.head.flags & (STEWART_SIMULATION | STEWART_SAFE_HOLDS)))
        stewart_start(&c.law, c.memory, 0, stewart_queue); /* a real machine has no torque before the first of the law */
{% endif %}
    if (!problem)
        problem = begin_log(&c);
    const int begins = !problem;
    if (begins) {
        printf("begins at %.3f s of the machine, round trip %.2f ms\n", 1e-9 * (double)c.begin,
               1e-6 * shortest_trip(&c.times));
        warn_of_link(&c);
        fflush(stdout);
        problem = drive(&c);
    }
    for (int i = 0; i < 3 && c.session.nonce; i++)
        say(&c, STEWART_STOP, 0, 0, 0);
    if (!begins)
        printf("not started: %s\n", problem);
    else
        printf("%s after %u samples, %u of them without a@" new" if wait@ measurement, %u late\n",
               problem ? problem : "completed", c.samples, c.missing, c.missed);
    udp_tell(c.refused);
    if (c.log)
        fclose(c.log);
    return problem != NULL;
}
