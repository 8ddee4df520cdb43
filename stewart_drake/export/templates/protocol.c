/* See protocol.h. Numbers are put together byte by byte: neither the order of bytes nor the alignment
   of this processor counts. */

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

/* HMAC-SHA256 (RFC 2104), 32 bytes. */
static void hmac(stewart_key key, const uint8_t *data, size_t size, uint8_t *outer)
{
    uint8_t pad[64] = {0}, inner[32];
    sha256 s;
    if (key.size > 64) {
        digest_begin(&s);
        digest_add(&s, key.bytes, key.size);
        digest_end(&s, pad);
    } else {
        memcpy(pad, key.bytes, key.size);
    }
    for (int i = 0; i < 64; i++)
        pad[i] ^= 0x36;
    digest_begin(&s);
    digest_add(&s, pad, 64);
    digest_add(&s, data, size);
    digest_end(&s, inner);
    for (int i = 0; i < 64; i++)
        pad[i] ^= 0x36 ^ 0x5c;
    digest_begin(&s);
    digest_add(&s, pad, 64);
    digest_add(&s, inner, 32);
    digest_end(&s, outer);
}

/* Its first STEWART_TAG bytes. */
static void tag_of(stewart_key key, const uint8_t *data, size_t size, uint8_t *tag)
{
    uint8_t whole[32];
    hmac(key, data, size, whole);
    memcpy(tag, whole, STEWART_TAG);
}

/* ---------------------------------------------------------------- numbers */

static void put(uint8_t **at, uint64_t value, int bytes)
{
    for (int i = 0; i < bytes; i++)
        *(*at)++ = (uint8_t)(value >> 8 * i);
}

static void put_double(uint8_t **at, double value)
{
    uint64_t bits;
    memcpy(&bits, &value, sizeof bits);
    put(at, bits, 8);
}

static void put_doubles(uint8_t **at, const double *values, int number)
{
    for (int i = 0; i < number; i++)
        put_double(at, values[i]);
}

static uint64_t get(const uint8_t **at, int bytes)
{
    uint64_t value = 0;
    for (int i = 0; i < bytes; i++)
        value |= (uint64_t)*(*at)++ << 8 * i;
    return value;
}

static double get_double(const uint8_t **at)
{
    uint64_t bits = get(at, 8);
    double value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

/* Whether all of them are finite. */
static int get_doubles(const uint8_t **at, double *values, int number)
{
    int finite = 1;
    for (int i = 0; i < number; i++) {
        values[i] = get_double(at);
        finite &= isfinite(values[i]) != 0;
    }
    return finite;
}

/* ---------------------------------------------------------------- head and tag */

static void put_head(uint8_t **at, const char *magic, const stewart_head *h, stewart_key key)
{
    memcpy(*at, magic, 4);
    *at += 4;
    put(at, STEWART_PROTOCOL, 1);
    put(at, key.size ? STEWART_TAG : 0, 1);
    put(at, 0, 2); /* the length, once it is known */
    put(at, h->session, 8);
    put(at, h->nonce, 8);
    put(at, h->sequence, 4);
    put(at, h->acknowledged, 4);
    put(at, h->time, 8);
    put(at, h->echo, 8);
    put(at, h->held, 8);
    put(at, h->flags, 4);
}

static size_t finish(uint8_t *data, uint8_t *end, stewart_key key)
{
    size_t size = (size_t)(end - data) + (key.size ? STEWART_TAG : 0);
    uint8_t *length = data + 6;
    put(&length, size, 2);
    if (key.size)
        tag_of(key, data, (size_t)(end - data), end);
    return size;
}

static int same_kind(const uint8_t *data, const char *magic)
{
    return memcmp(data, magic, 4) == 0;
}

/* What head and tag say; `at` is left at the body, of `body` bytes. */
static int get_head(const uint8_t *data, size_t size, stewart_key key, stewart_head *h,
                    const uint8_t **at, size_t *body)
{
    if (size < STEWART_HEAD || size > STEWART_LONGEST ||
        !(same_kind(data, "STWM") || same_kind(data, "STWC")))
        return STEWART_MALFORMED;
    if (data[4] != STEWART_PROTOCOL)
        return STEWART_VERSION;
    *at = data + 5;
    size_t tag = (size_t)get(at, 1), length = (size_t)get(at, 2);
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
    h->session = get(at, 8);
    h->nonce = get(at, 8);
    h->sequence = (uint32_t)get(at, 4);
    h->acknowledged = (uint32_t)get(at, 4);
    h->time = get(at, 8);
    h->echo = get(at, 8);
    h->held = get(at, 8);
    h->flags = (uint32_t)get(at, 4);
    *body = size - STEWART_HEAD - tag;
    return h->session == 0 || h->sequence == 0 ? STEWART_MALFORMED : STEWART_TAKEN;
}

/* Read the head of a datagram of a kind with a body of at least `least` bytes. */
static int get_head_of(const char *magic, size_t least, const uint8_t *data, size_t size,
                       stewart_key key, stewart_head *h, const uint8_t **at, size_t *body)
{
    int refused = get_head(data, size, key, h, at, body);
    if (refused)
        return refused;
    return same_kind(data, magic) && *body >= least ? STEWART_TAKEN : STEWART_MALFORMED;
}

size_t stewart_write_version(const uint8_t *data, uint8_t *answer)
{
    const uint8_t *session = data + 8, *sequence = data + 24;
    stewart_key none = {NULL, 0};
    stewart_head head = {get(&session, 8), 0, 1, (uint32_t)get(&sequence, 4), 0, 0, 0, 0};
    put_head(&answer, "STWM", &head, none);
    return finish(answer - STEWART_HEAD, answer, none);
}

/* ---------------------------------------------------------------- identity */

#define IDENTITY (STEWART_PARTS * (STEWART_DIGEST + STEWART_NAME))

static void put_identity(uint8_t **at, const stewart_identity *identity)
{
    for (int i = 0; i < STEWART_PARTS; i++) {
        const stewart_part *part = &identity->parts[i];
        int ended = 0;
        memcpy(*at, part->digest, STEWART_DIGEST);
        *at += STEWART_DIGEST;
        for (int j = 0; j < STEWART_NAME; j++) {
            ended |= part->name[j] == 0;
            *(*at)++ = ended ? 0 : (uint8_t)part->name[j];
        }
    }
}

/* Whether all names can be printed. */
static int get_identity(const uint8_t **at, stewart_identity *identity)
{
    int printable = 1;
    for (int i = 0; i < STEWART_PARTS; i++) {
        stewart_part *part = &identity->parts[i];
        int ended = 0;
        memcpy(part->digest, *at, STEWART_DIGEST);
        *at += STEWART_DIGEST;
        for (int j = 0; j < STEWART_NAME; j++) {
            uint8_t letter = *(*at)++;
            ended |= letter == 0;
            printable &= ended ? letter == 0 : letter >= 0x20 && letter <= 0x7e;
            part->name[j] = (char)(letter & 0x7f);
        }
        part->name[STEWART_NAME] = 0;
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

/* Contents of a datagram; 0: torques. */
enum { REQUEST = 1, CRANKS = 2 };

size_t stewart_write_measured(const stewart_measured *m, stewart_key key, uint8_t *data)
{
    uint8_t *at = data;
    put_head(&at, "STWM", &m->head, key);
    put(&at, m->kind, 1);
    put(&at, m->samples, 1);
    put(&at, m->bits, 1);
    put(&at, m->history, 1);
    put(&at, m->sampled, 8);
    put(&at, m->begin, 8);
    put(&at, m->period, 8);
    put(&at, m->watchdog, 8);
    put_double(&at, m->rate);
    put_double(&at, m->torque_limit);
    put(&at, m->arrived, 8);
    put(&at, m->acted_from, 8);
    put(&at, m->played, 4);
    put(&at, m->dry, 4);
    put(&at, m->refused, 4);
    put(&at, m->reason.fault, 1);
    put(&at, m->reason.leg, 1);
    put(&at, m->before.fault, 1);
    put(&at, m->cranks ? CRANKS : 0, 1);
    put(&at, m->reason.lasted, 8);
    put(&at, m->before.lasted, 8);
    if (m->kind == STEWART_OFFER)
        put_identity(&at, &m->identity);
    if (m->kind == STEWART_STATE)
        put_doubles(&at, m->state, 12);
    if (m->kind == STEWART_ENCODERS) {
        put_doubles(&at, m->zeros, 6);
        for (int i = 0; i < m->samples; i++)
            for (int leg = 0; leg < 6; leg++)
                put(&at, (uint32_t)m->codes[i][leg], 4);
    }
    put_doubles(&at, &m->acted[0][0], 6 * m->history);
    return finish(data, at, key);
}

static int plausible(const stewart_measured *m, uint64_t content)
{
    int fits = (m->kind == STEWART_NOTHING && m->samples == 0 && m->bits == 0) ||
               (m->kind == STEWART_OFFER && m->samples == 0 && m->bits == 0 && m->history == 0) ||
               (m->kind == STEWART_STATE && m->samples == 1 && m->bits == 0) ||
               (m->kind == STEWART_ENCODERS && m->samples >= 1 && m->samples <= STEWART_SAMPLES &&
                m->bits >= 1 && m->bits <= STEWART_BITS);
    return fits && m->history <= STEWART_HISTORY && m->rate > 0 && isfinite(m->rate) &&
           m->torque_limit > 0 && m->period > 0 && (content == 0 || content == CRANKS) &&
           m->head.flags < 1024 &&
           m->reason.fault < STEWART_FAULTS && m->reason.leg <= 6 && m->before.fault < STEWART_FAULTS;
}

int stewart_read_measured(const uint8_t *data, size_t size, stewart_key key, stewart_measured *m)
{
    const uint8_t *at;
    size_t body;
    memset(m, 0, sizeof *m);
    int refused = get_head_of("STWM", MACHINE_BODY, data, size, key, &m->head, &at, &body);
    if (refused)
        return refused;
    m->kind = (uint8_t)get(&at, 1);
    m->samples = (uint8_t)get(&at, 1);
    m->bits = (uint8_t)get(&at, 1);
    m->history = (uint8_t)get(&at, 1);
    m->sampled = get(&at, 8);
    m->begin = get(&at, 8);
    m->period = get(&at, 8);
    m->watchdog = get(&at, 8);
    m->rate = get_double(&at);
    m->torque_limit = get_double(&at);
    m->arrived = get(&at, 8);
    m->acted_from = get(&at, 8);
    m->played = (uint32_t)get(&at, 4);
    m->dry = (uint32_t)get(&at, 4);
    m->refused = (uint32_t)get(&at, 4);
    m->reason.fault = (uint8_t)get(&at, 1);
    m->reason.leg = (uint8_t)get(&at, 1);
    m->before.fault = (uint8_t)get(&at, 1);
    uint64_t content = get(&at, 1);
    m->cranks = content == CRANKS;
    m->reason.lasted = get(&at, 8);
    m->before.lasted = get(&at, 8);
    if (!plausible(m, content))
        return STEWART_MALFORMED;
    size_t measured = m->kind == STEWART_STATE      ? 96u
                      : m->kind == STEWART_OFFER    ? IDENTITY
                      : m->kind == STEWART_ENCODERS ? 48u + 24u * m->samples
                                                    : 0u;
    if (body != MACHINE_BODY + measured + 48u * m->history)
        return STEWART_MALFORMED;
    int finite = 1;
    if (m->kind == STEWART_OFFER)
        return get_identity(&at, &m->identity) ? STEWART_TAKEN : STEWART_MALFORMED;
    if (m->kind == STEWART_STATE)
        get_doubles(&at, m->state, 12); /* NaN is what was lost */
    if (m->kind == STEWART_ENCODERS) {
        finite = get_doubles(&at, m->zeros, 6);
        for (int i = 0; i < m->samples; i++)
            for (int leg = 0; leg < 6; leg++) {
                uint32_t code = (uint32_t)get(&at, 4);
                memcpy(&m->codes[i][leg], &code, sizeof code);
            }
    }
    finite &= get_doubles(&at, &m->acted[0][0], 6 * m->history);
    return finite ? STEWART_TAKEN : STEWART_MALFORMED;
}

/* ---------------------------------------------------------------- controller to machine */

#define CONTROLLER_BODY 28
#define PADDING (MACHINE_BODY - CONTROLLER_BODY) /* a request is as long as its answer */

size_t stewart_write_plan(const stewart_plan *m, stewart_key key, uint8_t *data)
{
    uint8_t *at = data;
    put_head(&at, "STWC", &m->head, key);
    put(&at, m->asks ? 0 : m->rows, 1);
    put(&at, m->asks ? REQUEST : m->cranks ? CRANKS : 0, 1);
    put(&at, 0, 2);
    put(&at, m->sampled, 8);
    put(&at, m->playout, 8);
    put(&at, m->begin, 8);
    if (m->asks) {
        put_identity(&at, &m->identity);
        memset(at, 0, PADDING);
        at += PADDING;
    } else {
        put_doubles(&at, &m->torques[0][0], 6 * m->rows);
    }
    return finish(data, at, key);
}

int stewart_read_plan(const uint8_t *data, size_t size, stewart_key key, stewart_plan *m)
{
    const uint8_t *at;
    size_t body;
    memset(m, 0, sizeof *m);
    int refused = get_head_of("STWC", CONTROLLER_BODY, data, size, key, &m->head, &at, &body);
    if (refused)
        return refused;
    m->rows = (uint8_t)get(&at, 1);
    uint64_t content = get(&at, 1), zero = get(&at, 2);
    m->asks = content == REQUEST;
    m->cranks = content == CRANKS;
    m->sampled = get(&at, 8);
    m->playout = get(&at, 8);
    m->begin = get(&at, 8);
    if (m->rows > STEWART_ROWS || content > CRANKS || (m->asks && m->rows) || zero || m->head.flags > 3 ||
        body != CONTROLLER_BODY + (m->asks ? IDENTITY + PADDING : 48u * m->rows))
        return STEWART_MALFORMED;
    if (m->asks) {
        int good = get_identity(&at, &m->identity);
        for (int i = 0; i < PADDING; i++)
            good &= *at++ == 0;
        return good ? STEWART_TAKEN : STEWART_MALFORMED;
    }
    int finite = get_doubles(&at, &m->torques[0][0], 6 * m->rows);
    return finite && !(m->rows && m->begin == STEWART_NEVER) ? STEWART_TAKEN : STEWART_MALFORMED;
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
    uint8_t data[18], digest[32], *at = data;
    const uint8_t *from = digest;
    put(&at, session, 8);
    put(&at, address, 4);
    put(&at, port, 2);
    put(&at, offers->sessions, 4);
    hmac(key, data, sizeof data, digest);
    uint64_t nonce = get(&from, 8);
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
