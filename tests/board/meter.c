/* Instructions and stack of each step on a Cortex-M under QEMU's `-icount shift=0`, where an
   instruction takes 1 ns of the emulated time and SysTick counts at 25 MHz. */

#include <stdint.h>
#include <stdio.h>

#include "meter.h"

#define MOST_STEPS 1000
#define INSTRUCTIONS_PER_TICK 40
#define MOST_TICKS 0xFFFFFFu
#define PAINT 0x5A17C0DEu
#define PAINTED 16384 /* words, from the top of the stack of a step down */

#define SYSTICK_CONTROL (*(volatile uint32_t *)0xE000E010)
#define SYSTICK_RELOAD (*(volatile uint32_t *)0xE000E014)
#define SYSTICK_COUNT (*(volatile uint32_t *)0xE000E018) /* downwards */

static uint32_t began, ticks[MOST_STEPS], depth[MOST_STEPS];
static volatile uint32_t *top; /* of the stack of a step */

__attribute__((noinline)) void meter_start(void)
{
    top = __builtin_frame_address(0);
    for (int word = 16; word < PAINTED; word++) /* below what this function has there itself */
        top[-word] = PAINT;
    SYSTICK_RELOAD = MOST_TICKS;
    SYSTICK_CONTROL = 5; /* on, by the processor's clock, without interrupts */
    began = SYSTICK_COUNT;
}

__attribute__((noinline)) void meter_stop(int step)
{
    uint32_t now = SYSTICK_COUNT;
    int words = PAINTED - 1;
    while (words > 0 && top[-words] == PAINT)
        words--;
    if (step < MOST_STEPS) {
        ticks[step] = (began - now) & MOST_TICKS;
        depth[step] = 4u * (uint32_t)words;
    }
}

void meter_report(int steps)
{
    for (int k = 0; k < steps && k < MOST_STEPS; k++)
        printf("step %d: instructions %lu, stack %lu B\n", k,
               (unsigned long)ticks[k] * INSTRUCTIONS_PER_TICK, (unsigned long)depth[k]);
}
