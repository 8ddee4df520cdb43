/* A machine behind a socket, as an example: what a board must do, with a simulated plate in the place
   of motors and sensors. See docs/protocol.md.

       ./stewart_machine PORT [SECONDS [KEYFILE]]

   A board replaces `plate_follow` and `plate_read` by its own, and leaves out STEWART_SIMULATION. */

#define _POSIX_C_SOURCE 200809L

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "stewart_config.h"
#include "stewart_motion.h"
#include "udp.h"

#define WAITING 1024         /* torques that wait for their time, at the most */
#define FINEST 1000000u      /* ns, a step of the simulated plate */
#define WATCHDOG SECOND      /* ns of silence */
#define FURTHEST (3600ull * SECOND)

typedef struct {
    uint64_t at;
    uint32_t sequence; /* of the plan, 0 of what was in flight at the start */
    double torque[6];
} row;

typedef struct {
    int socket;
    stewart_key key;
    uint64_t started, period;
    /* who drives, and who may next */
    stewart_session session, offered;
    struct sockaddr_in driver, asks;
    int driven, stopped;
    /* what acts, and what waits */
    row waiting[WAITING];
    int rows;
    double torque[6], acted[STEWART_HISTORY][6];
    int history;
    uint64_t acted_from, changed, begin, sample;
    int running, safe, counts_dry, left;
    uint32_t played, dry;
    unsigned refused[STEWART_REFUSALS], sent, silences;
    /* the simulated plate */
    uint64_t time;
    real state[STEWART_STATES];
} machine;

static uint64_t machine_now(const machine *m)
{
    return udp_now() - m->started;
}

/* ---------------------------------------------------------------- the plate: yours */

static int plate_left(const machine *m)
{
    real measures[STEWART_MEASURES];
    stewart_measures(stewart_configuration.geometry, m->state, NULL, measures);
    measures[6] *= stewart_home_sign;
    int left = 0;
    for (int i = 0; i < STEWART_MEASURES; i++)
        left |= !(measures[i] > stewart_least[i]);
    return left;
}

/* On to an instant under the torque that acts; brakes hold before the run. */
static void plate_follow(machine *m, uint64_t time)
{
    const stewart_config *c = &stewart_configuration;
    stewart_plant plant = {c->geometry, c->parameters, &c->gravity};
    real torque[6];
    for (int i = 0; i < 6; i++)
        torque[i] = (real)m->torque[i];
    while (m->running && !m->left && m->time < time) {
        uint64_t h = time - m->time < FINEST ? time - m->time : FINEST;
        stewart_move(&plant, torque, (real)(1e-9 * (double)h), m->state);
        m->time += h;
        m->left = plate_left(m);
        if (m->left)
            printf("the plate left its workspace at %.3f s; stopped\n", 1e-9 * (double)m->time);
    }
    m->time = time > m->time ? time : m->time;
}

static void plate_read(const machine *m, double *state)
{
    for (int i = 0; i < STEWART_STATES; i++)
        state[i] = (double)m->state[i];
}

/* ---------------------------------------------------------------- torques */

static double limited(double torque)
{
    double limit = (double)stewart_configuration.torque_limit;
    return fmax(-limit, fmin(limit, torque));
}

static void act(machine *m, const double *torque, uint64_t time)
{
    memmove(m->acted[1], m->acted[0], (STEWART_HISTORY - 1) * sizeof m->acted[0]);
    memcpy(m->torque, torque, sizeof m->torque);
    memcpy(m->acted[0], m->torque, sizeof m->torque);
    m->history += m->history < STEWART_HISTORY;
    m->acted_from = time;
}

static void keep(machine *m, uint64_t at, uint32_t sequence, const double *torque)
{
    int i = 0;
    while (i < m->rows && m->waiting[i].at != at)
        i++;
    if (i == WAITING || (i < m->rows && m->waiting[i].sequence > sequence))
        return;
    m->rows += i == m->rows;
    m->waiting[i].at = at;
    m->waiting[i].sequence = sequence;
    for (int j = 0; j < 6; j++)
        m->waiting[i].torque[j] = limited(torque[j]);
}

/* The row that is next, or -1. */
static int next_row(const machine *m)
{
    int next = -1;
    for (int i = 0; i < m->rows; i++)
        if (next < 0 || m->waiting[i].at < m->waiting[next].at)
            next = i;
    return next;
}

static uint64_t next_change(const machine *m)
{
    int next = next_row(m);
    if (!m->running || m->left)
        return STEWART_NEVER;
    if (m->counts_dry && (next < 0 || m->changed + m->period < m->waiting[next].at))
        return m->changed + m->period;
    return next < 0 ? STEWART_NEVER : m->waiting[next].at;
}

static void change(machine *m, uint64_t time)
{
    int next = next_row(m);
    plate_follow(m, time);
    m->changed = time;
    m->counts_dry = 1;
    if (next < 0 || m->waiting[next].at > time) {
        m->dry++;
        act(m, m->torque, time); /* held */
        return;
    }
    m->played += m->waiting[next].sequence > 0;
    m->safe = m->safe && m->waiting[next].sequence == 0;
    act(m, m->waiting[next].torque, time);
    m->waiting[next] = m->waiting[--m->rows];
}

static void go_safe(machine *m, uint64_t time)
{
    static const double zero[6];
    plate_follow(m, time);
    m->rows = m->counts_dry = 0;
    m->safe = 1;
    m->changed = time > m->changed ? time : m->changed;
    act(m, zero, time);
}

/* ---------------------------------------------------------------- the run */

static void put_back(machine *m)
{
    memcpy(m->state, stewart_start, sizeof m->state);
    memset(m->torque, 0, sizeof m->torque);
    m->begin = m->acted_from = STEWART_NEVER;
    m->rows = m->history = m->running = m->safe = m->left = m->counts_dry = 0;
    m->played = m->dry = 0;
    m->changed = 0;
}

static int alive(const machine *m, uint64_t time)
{
    return m->driven && !m->stopped && time - m->session.heard <= WATCHDOG;
}

static void begin(machine *m)
{
    if (!alive(m, m->begin)) {
        printf("nobody was heard when the run should have begun; still parked\n");
        m->begin = STEWART_NEVER;
        return;
    }
    const stewart_config *c = &stewart_configuration;
    int number = stewart_rows;
    double early = ((double)c->fraction - (number > c->steps)) * (double)m->period;
    double torque[6];
    m->time = m->begin;
    m->running = 1;
    for (int i = 0; i < number; i++) { /* what is in flight: a real machine has nothing */
        for (int j = 0; j < 6; j++)
            torque[j] = (double)stewart_queue[6 * i + j];
        keep(m, (uint64_t)((double)m->begin + early + 0.5) + (uint64_t)i * m->period, 0, torque);
    }
    printf("the run began at %.3f s\n", 1e-9 * (double)m->begin);
}

/* ---------------------------------------------------------------- what is said */

static void say(machine *m, stewart_session *to, const struct sockaddr_in *where, uint64_t sampled,
                uint32_t flags)
{
    static stewart_measured s;
    uint8_t data[STEWART_LONGEST];
    memset(&s, 0, sizeof s);
    flags |= STEWART_SIMULATION | STEWART_HOLDS | STEWART_RESETS;
    flags |= (uint32_t)(m->running ? STEWART_RUNNING : STEWART_PARKED);
    flags |= (uint32_t)((m->safe ? STEWART_SAFE : 0) | (m->left ? STEWART_LEFT : 0));
    s.head = stewart_next(to, machine_now(m), flags);
    s.kind = STEWART_STATE;
    s.samples = 1;
    s.history = (uint8_t)m->history;
    s.sampled = sampled;
    s.begin = to == &m->session ? m->begin : STEWART_NEVER;
    s.period = m->period;
    s.watchdog = WATCHDOG;
    s.rate = 1;
    s.torque_limit = (double)stewart_configuration.torque_limit;
    s.arrived = to->window.newest ? to->window.seen : 0;
    s.acted_from = m->history ? m->acted_from : STEWART_NEVER;
    s.played = m->played;
    s.dry = m->dry;
    for (int i = 1; i < STEWART_REFUSALS; i++)
        s.refused += m->refused[i];
    plate_read(m, s.state);
    memcpy(s.acted, m->acted, sizeof m->acted[0] * (size_t)m->history);
    m->sent += (unsigned)udp_put(m->socket, data, stewart_write_measured(&s, m->key, data), where);
}

/* ---------------------------------------------------------------- who drives */

static int greet(machine *m, const stewart_plan *plan, const struct sockaddr_in *from, uint64_t now)
{
    stewart_head head = plan->head;
    if (m->driven && head.session == m->session.number)
        return stewart_take(&m->session.window, head.sequence); /* it was overtaken */
    if (m->offered.number != head.session) {
        memset(&m->offered, 0, sizeof m->offered);
        m->offered.number = head.session;
        m->offered.nonce = udp_draw();
        m->asks = *from;
    }
    head.nonce = m->offered.nonce;
    if (!udp_same(from, &m->asks))
        return STEWART_FOREIGN;
    int cause = stewart_note(&m->offered, &head, now);
    if (!cause)
        say(m, &m->offered, from, m->time, alive(m, now) ? STEWART_BUSY : 0);
    return cause;
}

/* Torques; why they are of no use, or STEWART_TAKEN. */
static int plan_ahead(machine *m, const stewart_plan *plan, uint64_t now)
{
    if (plan->playout > now + FURTHEST ||
        (plan->begin != STEWART_NEVER && plan->begin > now + FURTHEST))
        return STEWART_MALFORMED;
    if (plan->begin != STEWART_NEVER && m->begin == STEWART_NEVER && !m->running) {
        uint64_t asked = plan->begin > now + 1 ? plan->begin : now + 1;
        m->begin = (asked + m->period - 1) / m->period * m->period;
    }
    uint64_t last = plan->playout + (plan->rows ? plan->rows - 1u : 0u) * m->period;
    if (plan->rows && (last < now || last <= m->changed))
        return STEWART_LATE;
    for (unsigned i = 0; i < plan->rows && !m->left; i++)
        if (plan->playout + i * m->period > m->changed)
            keep(m, plan->playout + i * m->period, plan->head.sequence, plan->torques[i]);
    return STEWART_TAKEN;
}

static int obey(machine *m, const stewart_plan *plan, uint64_t now)
{
    if (m->stopped)
        return STEWART_TAKEN;
    if (!(plan->head.flags & STEWART_STOP))
        return plan_ahead(m, plan, now);
    m->stopped = 1;
    if (m->running)
        go_safe(m, now);
    printf("the controller said stop at %.3f s\n", 1e-9 * (double)now);
    return STEWART_TAKEN;
}

static int arrive(machine *m, const stewart_plan *plan, const struct sockaddr_in *from, uint64_t now)
{
    const stewart_head *h = &plan->head;
    int cause;
    if (h->nonce == 0)
        return greet(m, plan, from, now);
    if (m->driven && h->session == m->session.number && h->nonce == m->session.nonce) {
        cause = udp_same(from, &m->driver) ? stewart_note(&m->session, h, now) : STEWART_FOREIGN;
        return cause ? cause : obey(m, plan, now);
    }
    if (alive(m, now) || m->offered.nonce == 0 || h->nonce != m->offered.nonce ||
        !udp_same(from, &m->asks))
        return STEWART_FOREIGN;
    cause = stewart_note(&m->offered, h, now);
    if (cause)
        return cause;
    m->session = m->offered;
    m->driver = m->asks;
    memset(&m->offered, 0, sizeof m->offered);
    m->driven = 1;
    m->stopped = 0;
    put_back(m);
    printf("a session begins\n");
    return obey(m, plan, now);
}

static void receive(machine *m)
{
    static uint8_t data[STEWART_LONGEST + 1];
    static stewart_plan plan;
    struct sockaddr_in from;
    size_t size;
    for (int i = 0; i < 256 && (size = udp_get(m->socket, data, &from)) > 0; i++) {
        int cause = stewart_read_plan(data, size, m->key, &plan);
        m->refused[cause ? cause : arrive(m, &plan, &from, machine_now(m))]++;
    }
}

/* All that is due by now, in its order; when there is something next. */
static uint64_t advance(machine *m, uint64_t now)
{
    for (;;) {
        int watched = m->driven && !m->stopped && !m->safe && m->running && !m->left;
        uint64_t silent = watched ? m->session.heard + WATCHDOG + 1 : STEWART_NEVER;
        uint64_t starts = m->running ? STEWART_NEVER : m->begin, changes = next_change(m);
        uint64_t next = m->sample;
        next = starts <= next ? starts : next;
        next = changes < next ? changes : next;
        next = silent < next ? silent : next;
        if (next > now)
            return next;
        if (next == silent) {
            m->silences++;
            go_safe(m, silent);
            printf("nothing was heard for %.3g s: the safe torque acts\n", 1e-9 * WATCHDOG);
        } else if (next == starts) {
            begin(m);
        } else if (next == m->sample) {
            plate_follow(m, next);
            if (m->driven)
                say(m, &m->session, &m->driver, next, 0);
            m->sample += m->period;
        } else {
            change(m, next);
        }
        fflush(stdout);
    }
}

int main(int argc, char **argv)
{
    static machine m;
    double seconds = argc > 2 && *argv[2] ? atof(argv[2]) : INFINITY;
    m.key = udp_key(argc > 3 ? argv[3] : NULL);
    if (argc < 2 || (argc > 3 && !m.key.size)) {
        fprintf(stderr, "expected: stewart_machine PORT [SECONDS [KEYFILE]]\n");
        return 2;
    }
    udp_interrupted();
    m.socket = udp_open((uint16_t)atoi(argv[1]), m.key);
    if (m.socket < 0)
        return 2;
    m.started = udp_now();
    m.period = (uint64_t)((double)stewart_configuration.period * SECOND + 0.5);
    put_back(&m);
    printf("a simulated machine at port %s, every %.4g ms; Ctrl-C ends it\n", argv[1],
           1e-6 * (double)m.period);
    fflush(stdout);
    while (!udp_interrupted() && 1e-9 * (double)machine_now(&m) < seconds) {
        receive(&m);
        udp_wait(m.socket, m.started + advance(&m, machine_now(&m)));
    }
    uint64_t now = machine_now(&m);
    if (m.running && !m.safe)
        go_safe(&m, now);
    if (m.driven)
        say(&m, &m.session, &m.driver, now, 0);
    printf("ended after %.1f s: %u measurements sent, %u torques played, %u periods dry, %u silences\n",
           1e-9 * (double)now, m.sent, (unsigned)m.played, (unsigned)m.dry, m.silences);
    udp_tell(m.refused);
    return 0;
}
