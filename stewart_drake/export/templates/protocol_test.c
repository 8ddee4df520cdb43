/* protocol.c against the vectors of docs/protocol.md. With a word as argument it is a filter instead:
   each line is a datagram as hexadecimal digits, read with that word as key (none if it is empty);
   it says why the datagram is refused, as a number, and writes what it read anew. */

#include <math.h>
#include <stdio.h>
#include <string.h>

#include "protocol.h"

static const char plan_bytes[] =
    "535457430300b800887766554433221101ffeeddccbbaa99070000000300000000f9029500000000d202964900000000"
    "40420f0000000000020000000200000000180d8f000000000020bcbe0000000000ca9a3b00000000000000000000e03f"
    "000000000000d0bf0000000000000000000000000000f03f000000000000f0bf0000000000000040000000000000c03f"
    "000000000000000000000000000000000000000000000000000000000000000000000000000020c0";
static const char keyed_bytes[] =
    "535457430310c800887766554433221101ffeeddccbbaa99070000000300000000f9029500000000d202964900000000"
    "40420f0000000000020000000200000000180d8f000000000020bcbe0000000000ca9a3b00000000000000000000e03f"
    "000000000000d0bf0000000000000000000000000000f03f000000000000f0bf0000000000000040000000000000c03f"
    "000000000000000000000000000000000000000000000000000000000000000000000000000020c0a3008625f8c2d8bc"
    "2375d4b5b6f2ba50";
static const char state_bytes[] =
    "5354574d03003001887766554433221101ffeeddccbbaa99070000000300000000f9029500000000d202964900000000"
    "40420f0000000000250000000101000100180d8f0000000000ca9a3b0000000000e1f5050000000000ca9a3b00000000"
    "000000000000f03f000000000000f07f0b0000000000000000180d8f0000000017000000010000000400000001020800"
    "00000000000000008066ab13000000000000000000000000000000000000e03f000000000000e0bf000000000000d03f"
    "0000000000000000000000000000d83f000000000000000000000000000000000000000000000000000000000000f03f"
    "0000000000000000000000000000f87f000000000000e03f000000000000d0bf0000000000000000000000000000f03f"
    "000000000000f0bf0000000000000040";
static const char encoder_bytes[] =
    "5354574d0300e800887766554433221101ffeeddccbbaa99070000000300000000f9029500000000d202964900000000"
    "40420f00000000000200000002010e0000180d8f00000000ffffffffffffffff00e1f5050000000000ca9a3b00000000"
    "000000000000f03f000000000000e03f0b00000000000000ffffffffffffffff00000000000000000000000000000000"
    "000000000000000000000000000000000000000000000000000000000000e03f00000000000000000000000000000000"
    "0000000000000000000000000000e0bf01000000ffffffff0010000000f0ffff0000000000000080";
static const char request_bytes[] =
    "5354574303004001887766554433221101ffeeddccbbaa99070000000300000000f9029500000000d202964900000000"
    "40420f0000000000000000000001000000000000000000000000000000000000ffffffffffffffffcf64bb0b8b5dc524"
    "7061706572000000000000000000000000000000000000000000000000000000a34af4522a9c347b302e312073000000"
    "000000000000000000000000000000000000000000000000cf771bba11620d6873746174650000000000000000000000"
    "00000000000000000000000000000000385123285c60d1e8746f72717565000000000000000000000000000000000000"
    "000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000000"
    "0000000000000000000000000000000000000000000000000000000000000000";
static const char offer_bytes[] =
    "5354574d03004001887766554433221101ffeeddccbbaa99070000000300000000f9029500000000d202964900000000"
    "40420f0000000000020000000300000000180d8f00000000ffffffffffffffff00e1f5050000000000ca9a3b00000000"
    "000000000000f03f000000000000e03f0b00000000000000ffffffffffffffff00000000000000000000000000000000"
    "00000000000000000000000000000000cf64bb0b8b5dc524706170657200000000000000000000000000000000000000"
    "0000000000000000a34af4522a9c347b302e312073000000000000000000000000000000000000000000000000000000"
    "cf771bba11620d687374617465000000000000000000000000000000000000000000000000000000385123285c60d1e8"
    "746f727175650000000000000000000000000000000000000000000000000000";
static const char crank_bytes[] =
    "5354574303008800887766554433221101ffeeddccbbaa99070000000300000000f9029500000000d202964900000000"
    "40420f0000000000000000000102000000180d8f000000000020bcbe0000000000ca9a3b00000000000000000000e03f"
    "000000000000d0bf0000000000000000000000000000f03f000000000000f0bf0000000000000040";

static const stewart_head head = {0x1122334455667788u, 0x99aabbccddeeff01u, 7, 3, 2500000000u,
                                  1234567890u, 1000000u, 0};
static const stewart_key none = {NULL, 0};
static const stewart_key key = {(const uint8_t *)"0123456789abcdef", 16};
static int failed;

static void check(int right, const char *what)
{
    if (!right)
        printf("wrong: %s\n", what);
    failed |= !right;
}

static size_t from_hex(const char *text, uint8_t *data)
{
    size_t size = 0;
    unsigned byte;
    for (; size <= STEWART_LONGEST && sscanf(text + 2 * size, "%2x", &byte) == 1; size++)
        data[size] = (uint8_t)byte;
    return size;
}

static int same(const uint8_t *data, size_t size, const char *text)
{
    uint8_t wanted[STEWART_LONGEST + 1];
    return size == from_hex(text, wanted) && memcmp(data, wanted, size) == 0;
}

/* Every shorter datagram, and every one with a byte changed, is refused or is another message. */
static void damage(const char *text, stewart_key with)
{
    uint8_t data[STEWART_LONGEST + 1], again[STEWART_LONGEST];
    stewart_plan plan;
    stewart_measured measured;
    size_t size = from_hex(text, data);
    for (size_t i = 0; i < size; i++) {
        check(stewart_read_plan(data, i, with, &plan) != STEWART_TAKEN, "a short plan");
        check(stewart_read_measured(data, i, with, &measured) != STEWART_TAKEN, "a short report");
        data[i] ^= 0x10;
        if (stewart_read_plan(data, size, with, &plan) == STEWART_TAKEN)
            check(!with.size && stewart_write_plan(&plan, with, again) == size &&
                      memcmp(data, again, size) == 0,
                  "a changed plan");
        if (stewart_read_measured(data, size, with, &measured) == STEWART_TAKEN)
            check(!with.size && stewart_write_measured(&measured, with, again) == size &&
                      memcmp(data, again, size) == 0,
                  "a changed report");
        data[i] ^= 0x10;
    }
}

static void test_plan(void)
{
    uint8_t data[STEWART_LONGEST + 1];
    stewart_plan plan = {.head = head, .rows = 2, .sampled = 2400000000u, .playout = 3200000000u,
                         .begin = 1000000000u,
                         .torques = {{0.5, -0.25, 0, 1, -1, 2}, {0.125, 0, 0, 0, 0, -8}}};
    stewart_plan read;
    plan.head.flags = STEWART_ARMED;
    check(same(data, stewart_write_plan(&plan, none, data), plan_bytes), "the plan");
    check(same(data, stewart_write_plan(&plan, key, data), keyed_bytes), "the plan with a key");
    size_t size = from_hex(keyed_bytes, data);
    check(stewart_read_plan(data, size, key, &read) == STEWART_TAKEN, "reading the plan");
    check(read.rows == 2 && read.torques[1][5] == -8 && read.playout == 3200000000u, "its values");
    check(stewart_read_plan(data, size, none, &read) == STEWART_KEY, "a tag and no key");
    data[size - 1] ^= 1;
    check(stewart_read_plan(data, size, key, &read) == STEWART_KEY, "a wrong tag");
    data[4] = 1;
    check(stewart_read_plan(data, size, key, &read) == STEWART_VERSION, "another version");
    plan.head.flags = 0;
    plan.rows = 1;
    plan.content = STEWART_CRANKS;
    check(same(data, stewart_write_plan(&plan, none, data), crank_bytes), "crank angles");
    size = from_hex(crank_bytes, data);
    check(stewart_read_plan(data, size, none, &read) == STEWART_TAKEN && read.content == STEWART_CRANKS,
          "reading them");
    damage(plan_bytes, none);
    damage(keyed_bytes, key);
    damage(crank_bytes, none);
}

static void test_measured(void)
{
    uint8_t data[STEWART_LONGEST + 1];
    stewart_measured read;
    stewart_measured state = {.head = head, .kind = STEWART_STATE, .samples = 1, .history = 1,
                              .sampled = 2400000000u, .begin = 1000000000u, .period = 100000000u,
                              .watchdog = 1000000000u, .rate = 1, .torque_limit = INFINITY,
                              .arrived = 11, .acted_from = 2400000000u, .played = 23, .dry = 1,
                              .refused = 4,
                              .reason = {STEWART_REACH, 2, 0},
                              .before = {STEWART_STOOD, 0, 330000000u},
                              .state = {0, 0.5, -0.5, 0.25, 0, 0.375, 0, 0, 0, 1, 0, NAN},
                              .acted = {{0.5, -0.25, 0, 1, -1, 2}}};
    state.head.flags = STEWART_SIMULATION | STEWART_RUNNING | STEWART_HOLDS;
    check(same(data, stewart_write_measured(&state, none, data), state_bytes), "the state");
    size_t size = from_hex(encoder_bytes, data);
    check(stewart_read_measured(data, size, none, &read) == STEWART_TAKEN, "reading encoders");
    check(read.codes[0][3] == -4096 && read.codes[0][5] == STEWART_UNREAD && read.bits == 14 &&
              read.zeros[5] == -0.5 && read.begin == STEWART_NEVER,
          "their values");
    check(same(data, stewart_write_measured(&read, none, data), encoder_bytes), "encoders");
    damage(state_bytes, none);
    damage(encoder_bytes, none);
}

static const stewart_identity paper = {{
    {{0xcf, 0x64, 0xbb, 0x0b, 0x8b, 0x5d, 0xc5, 0x24}, "paper"},
    {{0xa3, 0x4a, 0xf4, 0x52, 0x2a, 0x9c, 0x34, 0x7b}, "0.1 s"},
    {{0xcf, 0x77, 0x1b, 0xba, 0x11, 0x62, 0x0d, 0x68}, "state"},
    {{0x38, 0x51, 0x23, 0x28, 0x5c, 0x60, 0xd1, 0xe8}, "torque"}}};

static void test_greeting(void)
{
    uint8_t data[STEWART_LONGEST + 1];
    stewart_plan request = {.head = head, .content = STEWART_REQUEST, .begin = STEWART_NEVER,
                            .identity = paper};
    stewart_plan asked;
    stewart_measured offer = {.head = head, .kind = STEWART_OFFER, .sampled = 2400000000u,
                              .begin = STEWART_NEVER, .period = 100000000u, .watchdog = 1000000000u,
                              .rate = 1, .torque_limit = 0.5, .arrived = 11,
                              .acted_from = STEWART_NEVER, .identity = paper};
    stewart_measured read;
    offer.head.flags = STEWART_PARKED;
    check(same(data, stewart_write_plan(&request, none, data), request_bytes), "the request");
    check(same(data, stewart_write_measured(&offer, none, data), offer_bytes), "the offer");
    size_t size = from_hex(offer_bytes, data);
    check(stewart_read_measured(data, size, none, &read) == STEWART_TAKEN &&
              strcmp(read.identity.parts[0].name, "paper") == 0,
          "reading the offer");
    size = from_hex(request_bytes, data);
    check(stewart_read_plan(data, size, none, &asked) == STEWART_TAKEN &&
              asked.content == STEWART_REQUEST,
          "the request");
    check(stewart_differing(&asked.identity, &read.identity) == 0, "the same identity");
    asked.identity.parts[2].digest[7] ^= 1;
    check(stewart_differing(&asked.identity, &read.identity) == 4, "another sensor");
    damage(request_bytes, none);
    damage(offer_bytes, none);
}

/* Nonces are of session, address, secret and the sessions so far; answers have a rate. */
static void test_offers(void)
{
    stewart_offers offers = {{1, 2, 3}, 0, 0, 0};
    uint64_t first = stewart_nonce(&offers, 7, 0x7f000001u, 50000), now = 1000000000u;
    unsigned answered = 0;
    check(first != 0 && first == stewart_nonce(&offers, 7, 0x7f000001u, 50000), "a nonce");
    check(first != stewart_nonce(&offers, 8, 0x7f000001u, 50000), "another session's nonce");
    check(first != stewart_nonce(&offers, 7, 0x7f000002u, 50000), "another address's nonce");
    check(first != stewart_nonce(&offers, 7, 0x7f000001u, 50001), "another port's nonce");
    offers.sessions = 1;
    check(first != stewart_nonce(&offers, 7, 0x7f000001u, 50000), "a nonce that was withdrawn");
    for (int i = 0; i < 10000; i++, now += 100000u)
        answered += (unsigned)stewart_may_answer(&offers, now);
    check(answered <= STEWART_ANSWERS + STEWART_AT_ONCE && answered >= STEWART_ANSWERS, "the rate");
}

static void test_window(void)
{
    static const struct {
        uint32_t sequence;
        int cause;
    } steps[] = {{1, STEWART_TAKEN},    {1, STEWART_REPLAYED}, {5, STEWART_TAKEN},
                 {3, STEWART_TAKEN},    {3, STEWART_REPLAYED}, {68, STEWART_TAKEN},
                 {5, STEWART_REPLAYED}, {4, STEWART_LATE},     {6, STEWART_TAKEN},
                 {500, STEWART_TAKEN},  {437, STEWART_TAKEN},  {436, STEWART_LATE}};
    stewart_window window = {0, 0};
    for (size_t i = 0; i < sizeof steps / sizeof steps[0]; i++)
        check(stewart_arrive(&window, steps[i].sequence) == steps[i].cause, "a window");
}

static int filter(stewart_key with)
{
    static char line[4 * STEWART_LONGEST];
    static uint8_t data[STEWART_LONGEST + 1];
    static stewart_plan plan;
    static stewart_measured measured;
    while (fgets(line, sizeof line, stdin)) {
        size_t size = from_hex(line, data);
        int report = size > 3 && data[3] == 'M';
        int cause = report ? stewart_read_measured(data, size, with, &measured)
                           : stewart_read_plan(data, size, with, &plan);
        size = 0;
        if (cause == STEWART_TAKEN)
            size = report ? stewart_write_measured(&measured, with, data)
                          : stewart_write_plan(&plan, with, data);
        printf("%d ", cause);
        for (size_t i = 0; i < size; i++)
            printf("%02x", data[i]);
        printf("\n");
    }
    return 0;
}

int main(int argc, char **argv)
{
    if (argc > 1) {
        stewart_key with = {(const uint8_t *)argv[1], strlen(argv[1])};
        return filter(with);
    }
    test_plan();
    test_measured();
    test_greeting();
    test_offers();
    test_window();
    printf("protocol: %s\n", failed ? "wrong" : "as documented");
    return failed;
}
