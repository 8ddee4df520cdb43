/* The datagrams between a machine and its controller: docs/protocol.md of stewart_drake defines
   every byte. No state, no allocation. Times are ns; torques N m; angles rad. */

#pragma once

#include <stddef.h>
#include <stdint.h>

#define STEWART_PROTOCOL 3 /* version of the protocol */
#define STEWART_LONGEST 1452
#define STEWART_HEAD 60
#define STEWART_TAG 16
#define STEWART_NEVER UINT64_MAX
#define STEWART_ROWS 24
#define STEWART_HISTORY 16
#define STEWART_SAMPLES 16
#define STEWART_BITS 30
#define STEWART_UNREAD INT32_MIN /* a code that was not read */
#define STEWART_VALUES (6 * STEWART_SAMPLES) /* largest size of a measurement */
#define STEWART_PARTS 4           /* of an identity: mechanism, period, sensor, actuator */
#define STEWART_DIGEST 8
#define STEWART_NAME 32
#define STEWART_SECRET 32
#define STEWART_ANSWERS 50 /* requests of unknown addresses that are answered in a second */
#define STEWART_AT_ONCE 10 /* of them, without a pause */

/* Why a datagram is not acted upon. */
enum {
    STEWART_TAKEN,
    STEWART_MALFORMED,
    STEWART_VERSION,
    STEWART_KEY,
    STEWART_FOREIGN,
    STEWART_REPLAYED,
    STEWART_LATE,
    STEWART_RATE,
    STEWART_REFUSALS
};

/* Flags of a machine, then of a controller. */
enum {
    STEWART_SIMULATION = 1,
    STEWART_PARKED = 2,
    STEWART_RUNNING = 4,
    STEWART_SAFE = 8,
    STEWART_LEFT = 16,
    STEWART_HOLDS = 32,
    STEWART_BUSY = 64,
    STEWART_WIRE = 128,
    STEWART_RESETS = 256,
    STEWART_SAFE_HOLDS = 512
};
enum { STEWART_STOP = 1, STEWART_ARMED = 2 };

/* Kinds of measurement; an offer has the machine's identity in its place. */
enum { STEWART_NOTHING, STEWART_STATE, STEWART_ENCODERS, STEWART_OFFER };

/* Contents of a datagram's rows; a request has the controller's identity and no rows. */
enum { STEWART_TORQUES, STEWART_REQUEST, STEWART_CRANKS /* setpoints, rad */ };

/* What kept a machine from going on. */
enum {
    STEWART_NO_FAULT,
    STEWART_REACH,
    STEWART_PITCH,
    STEWART_SINGULAR,
    STEWART_NOT_FINITE,
    STEWART_LEFT_WORKSPACE,
    STEWART_SILENCE,
    STEWART_SAID_STOP,
    STEWART_STOOD,
    STEWART_ENDED,
    STEWART_DRIVE,
    STEWART_DRY,
    STEWART_FAULTS
};

/* What machine and controller must agree on: bytes of SHA-256 of each part, and its name. */
typedef struct {
    uint8_t digest[STEWART_DIGEST];
    char name[STEWART_NAME + 1];
} stewart_part;

typedef struct {
    stewart_part parts[STEWART_PARTS];
} stewart_identity;

/* A fault, the leg from 1 on or 0, and how long it lasted, ns. */
typedef struct {
    uint8_t fault, leg;
    uint64_t lasted;
} stewart_reason;

typedef struct {
    uint64_t session, nonce;
    uint32_t sequence, acknowledged;
    uint64_t time, echo, held;
    uint32_t flags;
} stewart_head;

typedef struct {
    stewart_head head;
    uint8_t kind, samples, bits, history;
    uint64_t sampled, begin, period, watchdog;
    double rate, torque_limit;
    uint64_t arrived, acted_from;
    uint32_t played, dry, refused;
    stewart_reason reason, before; /* why torques do not act, and the fault before that */
    stewart_identity identity;     /* of an offer */
    double state[12], zeros[6]; /* the one or the other, by kind */
    int32_t codes[STEWART_SAMPLES][6];
    uint8_t content; /* of `acted` */
    double acted[STEWART_HISTORY][6];
} stewart_measured;

typedef struct {
    stewart_head head;
    uint8_t rows, content;
    uint16_t reserved; /* 0 */
    uint64_t sampled, playout, begin;
    stewart_identity identity;
    double torques[STEWART_ROWS][6];
} stewart_plan;

/* Shared by both sides, or of no bytes. */
typedef struct {
    const uint8_t *bytes;
    size_t size;
} stewart_key;

/* The bytes of a datagram, up to STEWART_LONGEST; returns how many. */
size_t stewart_write_measured(const stewart_measured *message, stewart_key key, uint8_t *data);
size_t stewart_write_plan(const stewart_plan *message, stewart_key key, uint8_t *data);

/* A datagram's message; returns STEWART_TAKEN, or why it is none: malformed, version or key. */
int stewart_read_measured(const uint8_t *data, size_t size, stewart_key key,
                          stewart_measured *message);
int stewart_read_plan(const uint8_t *data, size_t size, stewart_key key, stewart_plan *message);

/* The measurement in a datagram: a state (12), or crank angles (samples, 6), rad, the oldest first; NaN for
   what was not read. Returns how many numbers, 0 without a measurement. */
int stewart_values(const stewart_measured *message, double *values);

/* A head alone, which states this version to a controller of another one; `data` is its datagram.
   Returns STEWART_HEAD. */
size_t stewart_write_version(const uint8_t *data, uint8_t *answer);

/* Bit i is set where parts i differ. */
unsigned stewart_differing(const stewart_identity *one, const stewart_identity *other);

/* Which sequences were there already; starts as zeros. */
typedef struct {
    uint32_t newest;
    uint64_t seen; /* bit i is for newest - i: what `arrived` says */
} stewart_window;

/* STEWART_TAKEN, STEWART_REPLAYED or STEWART_LATE. */
int stewart_arrive(stewart_window *window, uint32_t sequence);

/* One side's view of a session. */
typedef struct {
    uint64_t number, nonce;
    stewart_window window;
    uint32_t sent;
    uint64_t echo, got; /* of the newest datagram: its time, and when it came by the own clock */
    uint64_t heard;     /* when the last one was taken */
} stewart_session;

/* The head of the next datagram, which is sent now. */
stewart_head stewart_next(stewart_session *session, uint64_t now, uint32_t flags);

/* Offers of sessions, without any memory of who has asked. */
typedef struct {
    uint8_t secret[STEWART_SECRET]; /* drawn at the start */
    uint32_t sessions;              /* so far; each one withdraws all offers */
    double tokens;
    uint64_t counted;
} stewart_offers;

/* The nonce that is offered to an address for a session, not 0. */
uint64_t stewart_nonce(const stewart_offers *offers, uint64_t session, uint32_t address, uint16_t port);

/* Whether an unknown address is answered now; then it counts. */
int stewart_may_answer(stewart_offers *offers, uint64_t now);

/* The answer to a request: its head, without flags. */
stewart_head stewart_answer(const stewart_head *request, uint64_t nonce, uint64_t now);

/* A machine's session, begun by a datagram with the nonce of an offer. */
stewart_session stewart_confirmed(const stewart_head *head, uint64_t now);

/* Why a datagram is not of this session, or STEWART_TAKEN: then it is noted. A nonce of 0 takes any. */
int stewart_note(stewart_session *session, const stewart_head *head, uint64_t now);
