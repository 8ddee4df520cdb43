/* Vectors and start of a Cortex-M4 or M7 that QEMU emulates, with newlib's output by semihosting. */

#include <stdint.h>
#include <stdlib.h>

extern uint32_t load_of_data[], data_begin[], data_end[], bss_begin[], bss_end[], stack_top[];
extern void initialise_monitor_handles(void);
extern int main(int, char **);

void start(void);

void start(void)
{
    volatile uint32_t *const access = (volatile uint32_t *)0xE000ED88; /* CPACR */
    *access |= 0x00F00000;                                             /* floating point */
    __asm volatile("dsb\n\tisb" ::: "memory");
    for (uint32_t *from = load_of_data, *to = data_begin; to != data_end;)
        *to++ = *from++;
    for (uint32_t *to = bss_begin; to != bss_end;)
        *to++ = 0;
    initialise_monitor_handles();
    static char name[] = "board";
    static char *arguments[] = {name, NULL};
    exit(main(1, arguments));
}

/* Ends the emulator with status 70, where it would hang: the semihosting call SYS_EXIT_EXTENDED. */
static void fault(void)
{
    static const uint32_t application_exit[2] = {0x20026, 70};
    __asm volatile("mov r0, #0x20\n\t"
                   "mov r1, %0\n\t"
                   "bkpt #0xab"
                   :
                   : "r"(application_exit)
                   : "r0", "r1", "memory");
    for (;;) {
    }
}

typedef union {
    void *stack;
    void (*handler)(void);
} vector;

__attribute__((section(".vectors"), used)) static const vector vectors[16] = {
    {.stack = stack_top}, {.handler = start}, {.handler = fault}, {.handler = fault},
    {.handler = fault},   {.handler = fault}, {.handler = fault}, {NULL},
    {NULL},               {NULL},             {NULL},             {.handler = fault},
    {.handler = fault},   {NULL},             {.handler = fault}, {.handler = fault},
};

/* newlib's exit calls the second. */
void _init(void);
void _fini(void);
void _init(void) {}
void _fini(void) {}
