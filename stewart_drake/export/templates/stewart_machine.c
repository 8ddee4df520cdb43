/* A machine behind a socket: session, play-out buffer, watchdog and reports of the protocol. See
   docs/protocol.md. Its motors and sensors are those of stewart_board.h.

       ./stewart_machine PORT [SECONDS [KEYFILE]] */

#define _POSIX_C_SOURCE 200809L

#include <math.h>
#include <stdio.h>
#include <string.h>

#include "link.h"
#include "stewart_board.h"
#include "stewart_config.h"
#include "stewart_example.h"
#include "udp.h"

#define USAGE "stewart_machine PORT [SECONDS [KEYFILE]]"
/* Largest number of waiting torques, one a period: for twice the delay of this controller, and four datagrams. */
#define WAITING (@2 * law.timeline.steps@ + 4 * STEWART_ROWS)
#define WATCHDOG SECOND      /* ns of silence */
#define FURTHEST (3600ull * SECOND) /* longest time ahead for a begin or a plan */
#define STALL (SECOND / 5)   /* delay of the process that is reported, ns */
#define RECENT (10ull * SECOND) /* time for which a fault counts as preceding the next one */
#define LAST_DATAGRAMS 3     /* datagrams at the end: some may be lost */
#define HOLDS @"0" if network and not law.channel.holds else "1"@ /* a dry buffer holds the last torque, or puts out zero */

/* Numbers of memory of the buffer, as `stewart_link_memory`: past commands with a time, waiting ones with time to
   act, sequence and arrival. */
enum { LINK = STEWART_LINK_COMMANDS + (1 + STEWART_MOTORS) * STEWART_HISTORY + (3 + STEWART_MOTORS) * WAITING };

typedef struct {
    int socket;
    stewart_key key;
    uint64_t started, period;
    /* session */
    stewart_session session;
    stewart_offers offers;
    struct sockaddr_in driver;
    uint64_t refused_session; /* last session whose refusal was printed */
    int driven, stopped;
    /* torques */
    stewart_link buffer;
    double link[LINK];
    uint64_t begin, sample;
    uint64_t phase; /* ns from a multiple of the period to a change of the torque */
    int running, safe, left;
    stewart_reason reason, before; /* why torques do not act, and the fault before that */
    uint64_t preceded, stalled_until; /* time of `before`; end of the last stall */
    unsigned refused[STEWART_REFUSALS], sent, silences;
    uint64_t time; /* of the plate */
} machine;

static uint64_t machine_now(const machine *m)
{
    return udp_now() - m->started;
}

/* ---------------------------------------------------------------- faults */

static void precede(machine *m, stewart_reason reason, uint64_t time)
{
    m->before = reason;
    m->preceded = time;
}

/* Set the reason why torques do not act. */
static void fail(machine *m, uint8_t fault, uint8_t leg, uint64_t lasted, uint64_t time)
{
    if (m->reason.fault)
        precede(m, m->reason, time);
    if (time - m->preceded > RECENT)
        m->before = (stewart_reason){0, 0, 0};
    m->reason = (stewart_reason){fault, leg, lasted};
}

/* Return the reason in words. */
static const char *why(const machine *m)
{
    static char text[160];
    udp_reason(&m->reason, &m->before, text, sizeof text);
    return text;
}

/* Let the safe torque act from a time on, until the next row does; empty the buffer unless `keeps`. */
static void drive_safely(machine *m, uint64_t time, int keeps)
{
    stewart_link_reset(&m->buffer, m->link, (double)time, (board_flags & STEWART_SAFE_HOLDS) != 0, keeps);
    board_drive(time, stewart_link_current(m->link));
    m->safe = 1;
}

/* Stop if the plate left its workspace, or the machine failed, by a time: the safe torque acts from then on. */
static void watch(machine *m, uint64_t time)
{
    uint64_t left_at = time;
    stewart_reason fault = {0, 0, 0};
    if (m->running && !m->left)
        fault = board_fault(time, &left_at);
    if (fault.fault) {
        m->left = 1;
        fail(m, fault.fault, fault.leg, fault.lasted, left_at);
        printf("%s at %.3f s: %s; stopped\n",
               fault.fault == STEWART_DRIVE ? "a fault" : "the plate left its workspace", 1e-9 * (double)left_at,
               why(m));
        drive_safely(m, time, 0);
    }
    m->time = time > m->time ? time : m->time;
}

/* ---------------------------------------------------------------- torques */

static uint64_t next_change(const machine *m)
{
    double next = m->running && !m->left ? stewart_link_next(&m->buffer, m->link) : (double)INFINITY;
    return isfinite(next) ? (uint64_t)next : STEWART_NEVER;
}

/* Go to the safe torque because nothing usable came from the controller for the time of the watchdog. */
static void starve(machine *m, uint8_t fault, uint64_t time, int keeps)
{
    drive_safely(m, time, keeps);
    fail(m, fault, 0, WATCHDOG, time);
    printf("%s: the safe torque acts at %.3f s\n", why(m), 1e-9 * (double)time);
}

static void change(machine *m, uint64_t time)
{
    watch(m, time);
    if (m->left)
        return;
    stewart_link_change(&m->buffer, m->link, (double)time);
    if ((double)time >= m->link[STEWART_LINK_SUPPLIED] + (double)WATCHDOG) {
        starve(m, STEWART_DRY, time, 1);
        return;
    }
    board_drive(time, stewart_link_current(m->link));
    if (m->safe && m->link[STEWART_LINK_FED] > 0) {
        precede(m, m->reason, time);
        m->reason = (stewart_reason){0, 0, 0};
        m->safe = 0;
    }
}

static void go_safe(machine *m, uint64_t time)
{
    watch(m, time);
    drive_safely(m, time, 0);
}

/* ---------------------------------------------------------------- the run */

static void put_back(machine *m)
{
    board_park();
    stewart_link_start(&m->buffer, m->link);
    m->begin = m->phase = STEWART_NEVER;
    m->running = m->safe = m->left = 0;
    m->preceded = 0;
    m->reason = m->before = (stewart_reason){0, 0, 0};
}

static int alive(const machine *m, uint64_t time)
{
    return m->driven && !m->stopped && time - m->session.heard <= WATCHDOG;
}

static void begin(machine *m)
{
    if (!alive(m, m->begin)) {
        printf("no controller was heard at the begin of the run: still parked\n");
        m->begin = STEWART_NEVER;
        stewart_link_start(&m->buffer, m->link); /* what waits is for times before the next begin */
        return;
    }
    const stewart_law *c = &stewart_configuration;
    int number = board_flags & STEWART_SIMULATION ? stewart_queue_rows : 0;
    /* The torque of sample k acts from sample k + steps + fraction on. The oldest one in a queue of steps + 1 rows is
       of k = -steps - 1: it has acted since before the begin. */
    double oldest_acts = ((double)c->fraction - (number > c->steps)) * (double)m->period; /* ns from the begin */
    double first = floor((double)m->begin + oldest_acts + 0.5), torque[STEWART_MOTORS];
    m->time = m->begin;
    m->running = 1;
    board_release(m->begin);
    for (int row = 0; row < number; row++) { /* in flight; a real machine has nothing */
        for (int i = 0; i < STEWART_MOTORS; i++)
            torque[i] = (double)stewart_queue[STEWART_MOTORS * row + i];
        stewart_link_preload(&m->buffer, m->link, first + row * (double)m->period, 1, torque);
    }
    printf("the run began at %.3f s\n", 1e-9 * (double)m->begin);
}

/* ---------------------------------------------------------------- messages */

/* Fill in the fields of every datagram. */
static void describe(const machine *m, uint64_t sampled, stewart_measured *s)
{
    memset(s, 0, sizeof *s);
    s->head.flags = (HOLDS ? STEWART_HOLDS : 0u) | board_flags;
    s->head.flags |= (uint32_t)(m->running ? STEWART_RUNNING : STEWART_PARKED);
    s->head.flags |= (uint32_t)((m->safe ? STEWART_SAFE : 0) | (m->left ? STEWART_LEFT : 0));
    s->sampled = sampled;
    s->begin = s->acted_from = STEWART_NEVER;
    s->period = m->period;
    s->watchdog = WATCHDOG;
    s->rate = 1;
    s->torque_limit = (double)stewart_configuration.machine.torque_limit;
    s->played = (uint32_t)m->link[STEWART_LINK_PLAYED];
    s->dry = (uint32_t)m->link[STEWART_LINK_DRY];
    for (int i = 1; i < STEWART_REFUSALS; i++)
        s->refused += m->refused[i];
    s->reason = m->reason;
    s->before = m->before;
}

/* Send a measurement and the torques that acted to the controller. */
static void say(machine *m, uint64_t sampled)
{
    static stewart_measured s;
    uint8_t data[STEWART_LONGEST];
    describe(m, sampled, &s);
    s.head = stewart_next(&m->session, machine_now(m), s.head.flags);
    s.kind = STEWART_STATE;
    s.samples = 1;
    s.history = (uint8_t)m->link[STEWART_LINK_ACTED];
    s.begin = m->begin;
    s.arrived = m->session.window.newest ? m->session.window.seen : 0;
    s.acted_from = s.history ? (uint64_t)m->link[STEWART_LINK_COMMANDS] : STEWART_NEVER;
    board_measure(sampled, s.state);
    for (int i = 0; i < s.history; i++)
        memcpy(s.acted[i], m->link + STEWART_LINK_COMMANDS + (1 + STEWART_MOTORS) * i + 1, sizeof s.acted[i]);
    m->sent += (unsigned)udp_put(m->socket, data, stewart_write_measured(&s, m->key, data), &m->driver);
}

/* ---------------------------------------------------------------- session */

/* Print a refusal, once for each session. */
static void refuse_aloud(machine *m, uint64_t session, const char *why)
{
    if (session != m->refused_session)
        printf("refused a controller: %s\n", why);
    m->refused_session = session;
}

/* Answer a request for a session, without keeping state of it. */
static int greet(machine *m, const stewart_plan *request, const struct sockaddr_in *from, uint64_t now)
{
    static stewart_measured s;
    uint8_t data[STEWART_LONGEST];
    const stewart_head *head = &request->head;
    uint64_t nonce = udp_nonce(&m->offers, head->session, from);
    if (m->driven && head->session == m->session.number)
        return STEWART_LATE; /* it was overtaken, or is replayed */
    if (head->nonce != nonce && !stewart_may_answer(&m->offers, now))
        return STEWART_RATE;
    if (stewart_differing(&stewart_own_identity, &request->identity)) {
        char why[UDP_DIFFERING];
        udp_differing(&stewart_own_identity, &request->identity, why);
        refuse_aloud(m, head->session, why);
        nonce = 0;
    }
    describe(m, m->time, &s);
    uint32_t flags = s.head.flags | (uint32_t)(alive(m, now) ? STEWART_BUSY : 0);
    s.head = stewart_answer(head, nonce, now);
    s.head.flags = flags;
    s.kind = STEWART_OFFER;
    s.arrived = 1;
    s.identity = stewart_own_identity;
    udp_put(m->socket, data, stewart_write_measured(&s, m->key, data), from);
    return STEWART_TAKEN;
}

/* Take a plan; return the cause of its refusal, or STEWART_TAKEN. */
static int plan_ahead(machine *m, const stewart_plan *plan, uint64_t now)
{
    if (plan->content == STEWART_CRANKS || plan->playout > now + FURTHEST ||
        (plan->begin != STEWART_NEVER && plan->begin > now + FURTHEST))
        return STEWART_MALFORMED;
    if (plan->begin != STEWART_NEVER && m->begin == STEWART_NEVER && !m->running) {
        if (!((board_flags & STEWART_SIMULATION) || (plan->head.flags & STEWART_ARMED))) {
            refuse_aloud(m, plan->head.session, "it is not armed, and this machine is real");
            return STEWART_TAKEN;
        }
        uint64_t asked = plan->begin > now + 1 ? plan->begin : now + 1;
        m->begin = (asked + m->period - 1) / m->period * m->period;
    }
    static const int causes[] = {STEWART_TAKEN, STEWART_MALFORMED, STEWART_LATE};
    if (m->left || !plan->rows)
        return STEWART_TAKEN;
    /* The first rows that are taken set the phase. */
    const uint64_t phase = plan->playout % m->period, since = now > m->begin ? now : m->begin;
    if (m->phase != STEWART_NEVER && m->phase != phase)
        return STEWART_MALFORMED;
    int cause = causes[stewart_link_take(&m->buffer, m->link, (double)since, (double)plan->head.sequence, 0,
                                         (double)plan->playout, (int)plan->rows, plan->torques[0])];
    m->phase = cause ? m->phase : phase;
    return cause;
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
    if (!m->left)
        fail(m, STEWART_SAID_STOP, 0, 0, now);
    printf("the controller said stop at %.3f s\n", 1e-9 * (double)now);
    return STEWART_TAKEN;
}

static int arrive(machine *m, const stewart_plan *plan, const struct sockaddr_in *from, uint64_t now)
{
    const stewart_head *h = &plan->head;
    int cause;
    if (plan->content == STEWART_REQUEST)
        return greet(m, plan, from, now);
    if (m->driven && h->session == m->session.number && h->nonce == m->session.nonce) {
        cause = udp_same(from, &m->driver) ? stewart_note(&m->session, h, now) : STEWART_FOREIGN;
        return cause ? cause : obey(m, plan, now);
    }
    if (alive(m, now) || h->nonce != udp_nonce(&m->offers, h->session, from))
        return STEWART_FOREIGN;
    if (m->running && !m->safe) /* its silence is found here first */
        go_safe(m, now);
    m->session = stewart_confirmed(h, now);
    m->driver = *from;
    m->offers.sessions++; /* withdraws what else was offered */
    m->driven = 1;
    m->stopped = 0;
    put_back(m);
    printf("a session begins\n");
    return obey(m, plan, now);
}

static void refuse_version(machine *m, const uint8_t *data, const struct sockaddr_in *from)
{
    uint8_t answer[STEWART_HEAD];
    char why[80];
    uint64_t session;
    if (!stewart_may_answer(&m->offers, machine_now(m)))
        return;
    memcpy(&session, data + 8, sizeof session); /* only compared */
    snprintf(why, sizeof why, "it speaks protocol version %u; expected %d", data[4], STEWART_PROTOCOL);
    refuse_aloud(m, session, why);
    udp_put(m->socket, answer, stewart_write_version(data, answer), from);
}

static void receive(machine *m)
{
    static uint8_t data[STEWART_LONGEST + 1];
    static stewart_plan plan;
    struct sockaddr_in from;
    size_t size;
    for (int i = 0; i < 256 && udp_get(m->socket, data, &size, &from); i++) {
        int cause = stewart_read_plan(data, size, m->key, &plan);
        m->refused[cause ? cause : arrive(m, &plan, &from, machine_now(m))]++;
        if (cause == STEWART_VERSION)
            refuse_version(m, data, &from);
    }
}

/* Process all events due by now; return the time of the next one. */
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
        if (m->running && now - next > STALL && next != silent && now > m->stalled_until) {
            stewart_reason stall = {STEWART_STOOD, 0, now - next};
            m->stalled_until = now;
            precede(m, stall, next);
            printf("at %.3f s: the machine stood still for %.2f s\n", 1e-9 * (double)next,
                   1e-9 * (double)stall.lasted);
        }
        if (next == silent) {
            m->silences++;
            watch(m, silent);
            starve(m, STEWART_SILENCE, silent, 0);
        } else if (next == starts) {
            begin(m);
        } else if (next == m->sample) {
            watch(m, next);
            if (m->driven)
                say(m, next);
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
    if (udp_help(argc, argv, USAGE))
        return 0;
    if (argc < 2 || argc > 4) {
        fprintf(stderr, "expected: " USAGE "\n");
        return 2;
    }
    double port = udp_number("PORT", argv[1], UDP_LAST_PORT, 0), seconds = INFINITY;
    if (argc > 2 && *argv[2])
        seconds = udp_number("SECONDS", argv[2], UDP_LONGEST, 1);
    m.key = udp_key(argc > 3 ? argv[3] : NULL);
    if (port == 0 || seconds == 0 || (argc > 3 && !m.key.size))
        return 2;
    udp_interrupted();
    m.socket = udp_open((uint16_t)port, m.key);
    if (m.socket < 0 || !udp_draw(m.offers.secret, sizeof m.offers.secret))
        return 2;
    m.offers.tokens = STEWART_AT_ONCE;
    m.started = udp_now();
    m.period = stewart_period;
    m.buffer = (stewart_link){.size = STEWART_MOTORS,
                              .max_waiting = WAITING,
                              .history = STEWART_HISTORY,
                              .hold_when_dry = HOLDS,
                              .period = (double)m.period,
                              .limit = stewart_configuration.machine.torque_limit};
    put_back(&m);
    printf("a %s machine at port %s, every %.4g ms; Ctrl-C ends it\n",
           board_flags & STEWART_SIMULATION ? "simulated" : "real", argv[1], 1e-6 * (double)m.period);
    fflush(stdout);
    while (!udp_interrupted() && 1e-9 * (double)machine_now(&m) < seconds) {
        receive(&m);
        udp_wait(m.socket, m.started + advance(&m, machine_now(&m)));
    }
    uint64_t now = machine_now(&m);
    if (m.running && !m.safe)
        go_safe(&m, now);
    if (!m.left)
        fail(&m, STEWART_ENDED, 0, 0, now);
    for (int i = 0; i < LAST_DATAGRAMS && m.driven; i++)
        say(&m, now);
    printf("ended after %.1f s: %u measurements sent, %u torques played, %u periods without one (dry), %u silences\n",
           1e-9 * (double)now, m.sent, (unsigned)m.link[STEWART_LINK_PLAYED],
           (unsigned)m.link[STEWART_LINK_DRY], m.silences);
    udp_tell(m.refused);
    return 0;
}
