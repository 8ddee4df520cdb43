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

static stewart_plan plan;
static stewart_measured measured;

/* Read a datagram and write it again, `written` bytes; return why it is refused. */
static int through(const uint8_t *data, size_t size, stewart_key with, uint8_t *again, size_t *written)
{
    const int report = size > 3 && data[3] == 'M';
    const int cause = report ? stewart_read_measured(data, size, with, &measured)
                             : stewart_read_plan(data, size, with, &plan);
    *written = 0;
    if (cause == STEWART_TAKEN)
        *written = report ? stewart_write_measured(&measured, with, again)
                          : stewart_write_plan(&plan, with, again);
    return cause;
}

/* A datagram is written as it was read. Every shorter one, and every one with a byte changed, is
   refused or is another message. */
static void test_bytes(const char *text, stewart_key with, const char *what)
{
    uint8_t data[STEWART_LONGEST + 1], again[STEWART_LONGEST];
    size_t size = from_hex(text, data), written;
    for (size_t i = 0; i < size; i++) {
        check(through(data, i, with, again, &written) != STEWART_TAKEN, "a short datagram");
        data[i] ^= 0x10;
        if (through(data, size, with, again, &written) == STEWART_TAKEN)
            check(!with.size && written == size && memcmp(data, again, size) == 0, "a changed one");
        data[i] ^= 0x10;
    }
    check(through(data, size, with, again, &written) == STEWART_TAKEN && written == size &&
              memcmp(data, again, size) == 0,
          what);
}

static int head_is_right(const stewart_head *h, uint32_t flags)
{
    return h->session == 0x1122334455667788u && h->nonce == 0x99aabbccddeeff01u && h->sequence == 7 &&
           h->acknowledged == 3 && h->time == 2500000000u && h->echo == 1234567890u &&
           h->held == 1000000u && h->flags == flags;
}

static void test_plans(void)
{
    uint8_t data[STEWART_LONGEST + 1];
    test_bytes(plan_bytes, none, "the plan");
    check(head_is_right(&plan.head, STEWART_ARMED) && plan.rows == 2 && plan.sampled == 2400000000u &&
              plan.playout == 3200000000u && plan.begin == 1000000000u && plan.torques[0][1] == -0.25 &&
              plan.torques[1][5] == -8,
          "its values");
    test_bytes(keyed_bytes, key, "the plan with a key");
    size_t size = from_hex(keyed_bytes, data);
    check(stewart_read_plan(data, size, none, &plan) == STEWART_KEY, "a tag and no key");
    check(stewart_read_measured(data, size, key, &measured) == STEWART_MALFORMED, "a plan as report");
    data[size - 1] ^= 1;
    check(stewart_read_plan(data, size, key, &plan) == STEWART_KEY, "a wrong tag");
    data[4] = 1;
    check(stewart_read_plan(data, size, key, &plan) == STEWART_VERSION, "another version");
    test_bytes(crank_bytes, none, "crank angles");
    check(plan.content == STEWART_CRANKS && plan.rows == 1, "their values");
}

static void test_reports(void)
{
    const stewart_measured *m = &measured;
    test_bytes(state_bytes, none, "the state");
    check(head_is_right(&m->head, STEWART_SIMULATION | STEWART_RUNNING | STEWART_HOLDS) &&
              m->kind == STEWART_STATE && m->sampled == 2400000000u && m->begin == 1000000000u &&
              m->period == 100000000u && m->watchdog == 1000000000u && m->rate == 1 &&
              isinf(m->torque_limit) && m->arrived == 11 && m->acted_from == 2400000000u &&
              m->played == 23 && m->dry == 1 && m->refused == 4 && m->reason.fault == STEWART_REACH &&
              m->reason.leg == 2 && m->before.fault == STEWART_STOOD && m->before.lasted == 330000000u &&
              m->state[5] == 0.375 && isnan(m->state[11]) && m->acted[0][5] == 2,
          "its values");
    double state[STEWART_VALUES];
    check(stewart_values(m, state) == 12 && memcmp(state, m->state, sizeof m->state) == 0, "the numbers");
    test_bytes(encoder_bytes, none, "encoders");
    check(m->codes[0][3] == -4096 && m->codes[0][5] == STEWART_UNREAD && m->bits == 14 &&
              m->zeros[5] == -0.5 && m->begin == STEWART_NEVER,
          "their values");
    double angles[STEWART_VALUES], quantum = 6.283185307179586 / 16384;
    check(stewart_values(m, angles) == 6 && angles[0] == quantum && angles[1] == 0.5 - quantum &&
              angles[3] == -4096 * quantum && angles[4] == 0 && isnan(angles[5]),
          "their angles");
}

static void test_greeting(void)
{
    test_bytes(offer_bytes, none, "the offer");
    test_bytes(request_bytes, none, "the request");
    check(plan.content == STEWART_REQUEST && measured.kind == STEWART_OFFER &&
              strcmp(measured.identity.parts[0].name, "paper") == 0,
          "their values");
    check(stewart_differing(&plan.identity, &measured.identity) == 0, "the same identity");
    plan.identity.parts[2].digest[7] ^= 1;
    check(stewart_differing(&plan.identity, &measured.identity) == 4, "another sensor");
    /* A name without an end is cut. */
    uint8_t data[STEWART_LONGEST];
    stewart_part *part = &plan.identity.parts[0];
    memset(part->name, 'n', sizeof part->name);
    size_t size = stewart_write_plan(&plan, none, data);
    check(stewart_read_plan(data, size, none, &plan) == STEWART_TAKEN &&
              strlen(part->name) == STEWART_NAME && strcmp(plan.identity.parts[2].name, "state") == 0,
          "a long name");
}

static int filter(stewart_key with)
{
    static char line[4 * STEWART_LONGEST];
    static uint8_t data[STEWART_LONGEST + 1], again[STEWART_LONGEST];
    while (fgets(line, sizeof line, stdin)) {
        size_t written;
        printf("%d ", through(data, from_hex(line, data), with, again, &written));
        for (size_t i = 0; i < written; i++)
            printf("%02x", again[i]);
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
    test_plans();
    test_reports();
    test_greeting();
    printf("protocol: %s\n", failed ? "wrong" : "as documented");
    return failed;
}
