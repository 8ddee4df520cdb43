/* See protocol.h. Numbers go byte by byte, so that the byte order and the alignment of this processor do
   not matter. A function `pass_..` does both, write and read. */

#include <math.h>
#include <string.h>

#include "protocol.h"

/* ---------------------------------------------------------------- SHA-256 (FIPS 180-4), HMAC */

typedef struct {
    uint32_t h[8];
    uint8_t block[64];
    uint64_t size;
} sha256;

static const uint32_t constants[64] = {
    0x428a2f98, 0x71374491, 0xb5c0fbcf, 0xe9b5dba5, 0x3956c25b, 0x59f111f1, 0x923f82a4, 0xab1c5ed5,
    0xd807aa98, 0x12835b01, 0x243185be, 0x550c7dc3, 0x72be5d74, 0x80deb1fe, 0x9bdc06a7, 0xc19bf174,
    0xe49b69c1, 0xefbe4786, 0x0fc19dc6, 0x240ca1cc, 0x2de92c6f, 0x4a7484aa, 0x5cb0a9dc, 0x76f988da,
    0x983e5152, 0xa831c66d, 0xb00327c8, 0xbf597fc7, 0xc6e00bf3, 0xd5a79147, 0x06ca6351, 0x14292967,
    0x27b70a85, 0x2e1b2138, 0x4d2c6dfc, 0x53380d13, 0x650a7354, 0x766a0abb, 0x81c2c92e, 0x92722c85,
    0xa2bfe8a1, 0xa81a664b, 0xc24b8b70, 0xc76c51a3, 0xd192e819, 0xd6990624, 0xf40e3585, 0x106aa070,
    0x19a4c116, 0x1e376c08, 0x2748774c, 0x34b0bcb5, 0x391c0cb3, 0x4ed8aa4a, 0x5b9cca4f, 0x682e6ff3,
    0x748f82ee, 0x78a5636f, 0x84c87814, 0x8cc70208, 0x90befffa, 0xa4506ceb, 0xbef9a3f7, 0xc67178f2};

static uint32_t turned(uint32_t x, int n)
{
    return x >> n | x << (32 - n);
}

static void digest_block(sha256 *s)
{
    uint32_t w[64], v[8];
    for (int i = 0; i < 16; i++)
        w[i] = (uint32_t)s->block[4 * i] << 24 | (uint32_t)s->block[4 * i + 1] << 16 |
               (uint32_t)s->block[4 * i + 2] << 8 | s->block[4 * i + 3];
    for (int i = 16; i < 64; i++)
        w[i] = w[i - 16] + w[i - 7] + (turned(w[i - 15], 7) ^ turned(w[i - 15], 18) ^ w[i - 15] >> 3) +
               (turned(w[i - 2], 17) ^ turned(w[i - 2], 19) ^ w[i - 2] >> 10);
    memcpy(v, s->h, sizeof v);
    for (int i = 0; i < 64; i++) {
        uint32_t e = v[4], a = v[0];
        uint32_t one = v[7] + (turned(e, 6) ^ turned(e, 11) ^ turned(e, 25)) +
                       ((e & v[5]) ^ (~e & v[6])) + constants[i] + w[i];
        uint32_t two = (turned(a, 2) ^ turned(a, 13) ^ turned(a, 22)) +
                       ((a & v[1]) ^ (a & v[2]) ^ (v[1] & v[2]));
        memmove(v + 1, v, 7 * sizeof v[0]);
        v[4] += one;
        v[0] = one + two;
    }
    for (int i = 0; i < 8; i++)
        s->h[i] += v[i];
}

static void digest_begin(sha256 *s)
{
    static const uint32_t first[8] = {0x6a09e667, 0xbb67ae85, 0x3c6ef372, 0xa54ff53a,
                                      0x510e527f, 0x9b05688c, 0x1f83d9ab, 0x5be0cd19};
    memcpy(s->h, first, sizeof first);
    s->size = 0;
}

static void digest_add(sha256 *s, const uint8_t *data, size_t size)
{
    for (size_t i = 0; i < size; i++) {
        s->block[s->size++ % 64] = data[i];
        if (s->size % 64 == 0)
            digest_block(s);
    }
}

static void digest_end(sha256 *s, uint8_t *out)
{
    uint64_t bits = 8 * s->size;
    uint8_t last[8], one = 0x80, zero = 0;
    digest_add(s, &one, 1);
    while (s->size % 64 != 56)
        digest_add(s, &zero, 1);
    for (int i = 0; i < 8; i++)
        last[i] = (uint8_t)(bits >> (56 - 8 * i));
    digest_add(s, last, 8);
    for (int i = 0; i < 32; i++)
        out[i] = (uint8_t)(s->h[i / 4] >> (24 - 8 * (i % 4)));
}

/* Begin with a block of a key, each of its bytes changed by `pad`. */
static void digest_key(sha256 *s, const uint8_t *block, uint8_t pad)
{
    digest_begin(s);
    for (int i = 0; i < 64; i++) {
        uint8_t byte = block[i] ^ pad;
        digest_add(s, &byte, 1);
    }
}

/* HMAC-SHA256 (RFC 2104), 32 bytes. */
static void hmac(stewart_key key, const uint8_t *data, size_t size, uint8_t *outer)
{
    uint8_t block[64] = {0}, inner[32];
    sha256 s;
    if (key.size > 64) {
        digest_begin(&s);
        digest_add(&s, key.bytes, key.size);
        digest_end(&s, block);
    } else {
        memcpy(block, key.bytes, key.size);
    }
    digest_key(&s, block, 0x36);
    digest_add(&s, data, size);
    digest_end(&s, inner);
    digest_key(&s, block, 0x5c);
    digest_add(&s, inner, 32);
    digest_end(&s, outer);
}

/* The first STEWART_TAG bytes of the HMAC. */
static void tag_of(stewart_key key, const uint8_t *data, size_t size, uint8_t *tag)
{
    uint8_t whole[32];
    hmac(key, data, size, whole);
    memcpy(tag, whole, STEWART_TAG);
}

/* ---------------------------------------------------------------- numbers */

/* A datagram up to here, to write to, or with `to` NULL to read from. */
typedef struct {
    uint8_t *to;
    const uint8_t *from;
} datagram;

/* Write or read numbers of `size` bytes, the lowest byte first. */
static void pass(datagram *d, void *numbers, size_t size, size_t count)
{
    const uint16_t one = 1;
    const int lowest_first = *(const uint8_t *)&one;
    uint8_t *bytes = numbers;
    for (size_t i = 0; i < size * count; i++) {
        uint8_t *byte = bytes + (lowest_first ? i : i / size * size + size - 1 - i % size);
        if (d->to)
            *d->to++ = *byte;
        else
            *byte = *d->from++;
    }
}

static int all_finite(const double *values, int count)
{
    for (int i = 0; i < count; i++)
        if (!isfinite(values[i]))
            return 0;
    return 1;
}

/* A number of a structure. Tables of them have the order of docs/protocol.md. */
typedef struct {
    size_t place, size;
} field;

#define FIELD(type, member) {offsetof(type, member), sizeof(((type *)NULL)->member)}
#define PASS(d, structure, fields) pass_fields(d, structure, fields, sizeof fields / sizeof *fields)

static void pass_fields(datagram *d, void *structure, const field *fields, size_t count)
{
    for (size_t i = 0; i < count; i++)
        pass(d, (uint8_t *)structure + fields[i].place, fields[i].size, 1);
}

/* ---------------------------------------------------------------- head and tag */

#define OF(member) FIELD(stewart_head, member)
static const field HEAD[] = {OF(session), OF(nonce), OF(sequence), OF(acknowledged),
                             OF(time),    OF(echo),  OF(held),     OF(flags)};
#undef OF

/* Write a head. */
static datagram put_head(uint8_t *data, const char *magic, stewart_head *h, stewart_key key)
{
    datagram d = {data + 8, NULL};
    memcpy(data, magic, 4);
    data[4] = STEWART_PROTOCOL;
    data[5] = key.size ? STEWART_TAG : 0; /* then the length, once it is known */
    PASS(&d, h, HEAD);
    return d;
}

static size_t finish(uint8_t *data, datagram d, stewart_key key)
{
    size_t size = (size_t)(d.to - data) + (key.size ? STEWART_TAG : 0);
    data[6] = (uint8_t)size;
    data[7] = (uint8_t)(size >> 8);
    if (key.size)
        tag_of(key, data, (size_t)(d.to - data), d.to);
    return size;
}

static int same_kind(const uint8_t *data, const char *magic)
{
    return memcmp(data, magic, 4) == 0;
}

/* Read and check head and tag of a datagram of a kind. `d` ends at the body, of `body` bytes, which are
   at least `least`. */
static int get_head(const char *magic, size_t least, const uint8_t *data, size_t size, stewart_key key,
                    stewart_head *h, datagram *d, size_t *body)
{
    if (size < STEWART_HEAD || size > STEWART_LONGEST ||
        !(same_kind(data, "STWM") || same_kind(data, "STWC")))
        return STEWART_MALFORMED;
    if (data[4] != STEWART_PROTOCOL)
        return STEWART_VERSION;
    *d = (datagram){NULL, data + 8};
    size_t tag = data[5], length = data[6] | (size_t)data[7] << 8;
    if (length != size || !(tag == 0 || tag == STEWART_TAG) || size < STEWART_HEAD + tag)
        return STEWART_MALFORMED;
    if ((tag != 0) != (key.size != 0))
        return STEWART_KEY;
    if (tag) {
        uint8_t right[STEWART_TAG], differs = 0;
        tag_of(key, data, size - tag, right);
        for (int i = 0; i < STEWART_TAG; i++)
            differs |= (uint8_t)(right[i] ^ data[size - tag + (size_t)i]);
        if (differs)
            return STEWART_KEY;
    }
    PASS(d, h, HEAD);
    *body = size - STEWART_HEAD - tag;
    return h->session && h->sequence && same_kind(data, magic) && *body >= least ? STEWART_TAKEN
                                                                                 : STEWART_MALFORMED;
}

size_t stewart_write_version(const uint8_t *data, uint8_t *answer)
{
    datagram d = {NULL, data + 8};
    stewart_key none = {NULL, 0};
    stewart_head read, head = {.sequence = 1};
    PASS(&d, &read, HEAD);
    head.session = read.session;
    head.acknowledged = read.sequence;
    return finish(answer, put_head(answer, "STWM", &head, none), none);
}

/* ---------------------------------------------------------------- identity */

#define IDENTITY (STEWART_PARTS * (STEWART_DIGEST + STEWART_NAME))

/* Write or read an identity, names with zeros at the end; return whether all names can be printed. */
static int pass_identity(datagram *d, stewart_identity *identity)
{
    int printable = 1;
    for (int i = 0; i < STEWART_PARTS; i++) {
        stewart_part *part = &identity->parts[i];
        pass(d, part->digest, 1, STEWART_DIGEST);
        part->name[STEWART_NAME] = 0;
        if (d->to)
            memset(part->name + strlen(part->name), 0, STEWART_NAME - strlen(part->name));
        pass(d, part->name, 1, STEWART_NAME);
        for (size_t j = 0, size = strlen(part->name); j < STEWART_NAME; j++)
            printable &= j < size ? part->name[j] >= 0x20 && part->name[j] <= 0x7e : !part->name[j];
    }
    return printable;
}

unsigned stewart_differing(const stewart_identity *one, const stewart_identity *other)
{
    unsigned differing = 0;
    for (unsigned i = 0; i < STEWART_PARTS; i++)
        if (memcmp(one->parts[i].digest, other->parts[i].digest, STEWART_DIGEST) != 0)
            differing |= 1u << i;
    return differing;
}

/* ---------------------------------------------------------------- machine to controller */

#define MACHINE_BODY 100

#define OF(member) FIELD(stewart_measured, member)
static const field MACHINE[] = {
    OF(kind),          OF(samples),      OF(bits),         OF(history),
    OF(sampled),       OF(begin),        OF(period),       OF(watchdog),
    OF(rate),          OF(torque_limit), OF(arrived),      OF(acted_from),
    OF(played),        OF(dry),          OF(refused),      OF(reason.fault),
    OF(reason.leg),    OF(before.fault), OF(content),      OF(reason.lasted),
    OF(before.lasted),
};
#undef OF

/* Write or read what follows these fields; return whether it is plausible. */
static int pass_measured(datagram *d, stewart_measured *m)
{
    int good = m->kind != STEWART_OFFER || pass_identity(d, &m->identity);
    if (m->kind == STEWART_STATE)
        pass(d, m->state, 8, 12); /* NaN for a lost value */
    if (m->kind == STEWART_ENCODERS) {
        pass(d, m->zeros, 8, 6);
        pass(d, m->codes, 4, 6u * m->samples);
    }
    pass(d, m->acted, 8, 6u * m->history);
    return good && all_finite(m->zeros, 6) && all_finite(m->acted[0], 6 * m->history);
}

size_t stewart_write_measured(const stewart_measured *message, stewart_key key, uint8_t *data)
{
    stewart_measured m = *message;
    datagram d = put_head(data, "STWM", &m.head, key);
    PASS(&d, &m, MACHINE);
    pass_measured(&d, &m);
    return finish(data, d, key);
}

static int plausible(const stewart_measured *m)
{
    int fits = (m->kind == STEWART_NOTHING && m->samples == 0 && m->bits == 0) ||
               (m->kind == STEWART_OFFER && m->samples == 0 && m->bits == 0 && m->history == 0) ||
               (m->kind == STEWART_STATE && m->samples == 1 && m->bits == 0) ||
               (m->kind == STEWART_ENCODERS && m->samples >= 1 && m->samples <= STEWART_SAMPLES &&
                m->bits >= 1 && m->bits <= STEWART_BITS);
    return fits && m->history <= STEWART_HISTORY && m->rate > 0 && isfinite(m->rate) &&
           m->torque_limit > 0 && m->period > 0 && m->content != STEWART_REQUEST &&
           m->content <= STEWART_CRANKS && m->head.flags < 1024 &&
           m->reason.fault < STEWART_FAULTS && m->reason.leg <= 6 && m->before.fault < STEWART_FAULTS;
}

int stewart_read_measured(const uint8_t *data, size_t size, stewart_key key, stewart_measured *m)
{
    datagram d;
    size_t body;
    memset(m, 0, sizeof *m);
    int refused = get_head("STWM", MACHINE_BODY, data, size, key, &m->head, &d, &body);
    if (refused)
        return refused;
    PASS(&d, m, MACHINE);
    size_t measured = m->kind == STEWART_STATE      ? 96u
                      : m->kind == STEWART_OFFER    ? IDENTITY
                      : m->kind == STEWART_ENCODERS ? 48u + 24u * m->samples
                                                    : 0u;
    return plausible(m) && body == MACHINE_BODY + measured + 48u * m->history && pass_measured(&d, m)
               ? STEWART_TAKEN
               : STEWART_MALFORMED;
}

int stewart_values(const stewart_measured *m, double *values)
{
    const double quantum = ldexp(6.283185307179586, -m->bits);
    if (m->kind == STEWART_STATE)
        memcpy(values, m->state, sizeof m->state);
    for (int i = 0; m->kind == STEWART_ENCODERS && i < 6 * m->samples; i++) {
        const int32_t code = m->codes[i / 6][i % 6];
        values[i] = code == STEWART_UNREAD ? (double)NAN : m->zeros[i % 6] + quantum * code;
    }
    return m->kind == STEWART_STATE ? 12 : m->kind == STEWART_ENCODERS ? 6 * m->samples : 0;
}

/* ---------------------------------------------------------------- controller to machine */

#define CONTROLLER_BODY 28
#define PADDING (MACHINE_BODY - CONTROLLER_BODY) /* a request is as long as its answer */

#define OF(member) FIELD(stewart_plan, member)
static const field PLAN[] = {OF(rows),    OF(content), OF(reserved),
                             OF(sampled), OF(playout), OF(begin)};
#undef OF

/* Write or read what follows these fields; return whether it is plausible. */
static int pass_plan(datagram *d, stewart_plan *m)
{
    uint8_t padding[PADDING] = {0};
    int good = m->content != STEWART_REQUEST || pass_identity(d, &m->identity);
    pass(d, padding, 1, m->content == STEWART_REQUEST ? PADDING : 0);
    for (int i = 0; i < PADDING; i++)
        good &= padding[i] == 0;
    pass(d, m->torques, 8, 6u * m->rows);
    return good && all_finite(m->torques[0], 6 * m->rows) && !(m->rows && m->begin == STEWART_NEVER);
}

size_t stewart_write_plan(const stewart_plan *message, stewart_key key, uint8_t *data)
{
    stewart_plan m = *message;
    m.rows = m.content == STEWART_REQUEST ? 0 : m.rows;
    m.reserved = 0;
    datagram d = put_head(data, "STWC", &m.head, key);
    PASS(&d, &m, PLAN);
    pass_plan(&d, &m);
    return finish(data, d, key);
}

int stewart_read_plan(const uint8_t *data, size_t size, stewart_key key, stewart_plan *m)
{
    datagram d;
    size_t body;
    memset(m, 0, sizeof *m);
    int refused = get_head("STWC", CONTROLLER_BODY, data, size, key, &m->head, &d, &body);
    if (refused)
        return refused;
    PASS(&d, m, PLAN);
    const int asks = m->content == STEWART_REQUEST;
    if (m->rows > STEWART_ROWS || m->content > STEWART_CRANKS || (asks && m->rows) || m->reserved ||
        m->head.flags > 3 || body != CONTROLLER_BODY + (asks ? IDENTITY + PADDING : 48u * m->rows))
        return STEWART_MALFORMED;
    return pass_plan(&d, m) ? STEWART_TAKEN : STEWART_MALFORMED;
}

/* ---------------------------------------------------------------- sessions */

int stewart_arrive(stewart_window *w, uint32_t sequence)
{
    if (sequence > w->newest) {
        uint32_t ahead = sequence - w->newest;
        w->seen = (ahead < 64 ? w->seen << ahead : 0) | 1;
        w->newest = sequence;
        return STEWART_TAKEN;
    }
    uint32_t behind = w->newest - sequence;
    if (behind >= 64)
        return STEWART_LATE;
    if (w->seen >> behind & 1)
        return STEWART_REPLAYED;
    w->seen |= (uint64_t)1 << behind;
    return STEWART_TAKEN;
}

stewart_head stewart_next(stewart_session *s, uint64_t now, uint32_t flags)
{
    uint32_t newest = s->window.newest;
    stewart_head head = {s->number, s->nonce, ++s->sent, newest, now, s->echo, newest ? now - s->got : 0,
                         flags};
    return head;
}

uint64_t stewart_nonce(const stewart_offers *offers, uint64_t session, uint32_t address, uint16_t port)
{
    stewart_key key = {offers->secret, STEWART_SECRET};
    uint8_t data[18], digest[32];
    uint32_t sessions = offers->sessions;
    uint64_t nonce;
    datagram hashed = {data, NULL}, made = {NULL, digest};
    pass(&hashed, &session, sizeof session, 1);
    pass(&hashed, &address, sizeof address, 1);
    pass(&hashed, &port, sizeof port, 1);
    pass(&hashed, &sessions, sizeof sessions, 1);
    hmac(key, data, sizeof data, digest);
    pass(&made, &nonce, sizeof nonce, 1);
    return nonce ? nonce : 1;
}

int stewart_may_answer(stewart_offers *offers, uint64_t now)
{
    offers->tokens += 1e-9 * STEWART_ANSWERS * (double)(now - offers->counted);
    offers->tokens = fmin(STEWART_AT_ONCE, offers->tokens);
    offers->counted = now;
    if (offers->tokens < 1)
        return 0;
    offers->tokens -= 1;
    return 1;
}

stewart_head stewart_answer(const stewart_head *request, uint64_t nonce, uint64_t now)
{
    stewart_head head = {request->session, nonce, request->sequence, request->sequence, now,
                         request->time, 0, 0};
    return head;
}

stewart_session stewart_confirmed(const stewart_head *head, uint64_t now)
{
    stewart_session session = {head->session, head->nonce, {0, 0}, head->sequence - 1, 0, 0, 0};
    stewart_note(&session, head, now);
    return session;
}

int stewart_note(stewart_session *s, const stewart_head *head, uint64_t now)
{
    if (head->session != s->number || (s->nonce != 0 && head->nonce != s->nonce))
        return STEWART_FOREIGN;
    uint32_t before = s->window.newest;
    int refused = stewart_arrive(&s->window, head->sequence);
    if (refused)
        return refused;
    s->heard = now;
    if (head->sequence > before) {
        s->echo = head->time;
        s->got = now;
    }
    return STEWART_TAKEN;
}
