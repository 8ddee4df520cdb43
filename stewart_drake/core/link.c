#include <string.h>

#include "link.h"

enum { AT, SEQUENCE, ARRIVAL, COMMAND }; /* places in the row of a waiting command; AT: its time to act */

static int width(const stewart_link *link) { return COMMAND + link->size; }

static double *acted(double *memory) { return memory + STEWART_LINK_COMMANDS; }

static int waiting_at(const stewart_link *link)
{
    return STEWART_LINK_COMMANDS + link->history * (1 + link->size);
}

static double *waiting(const stewart_link *link, double *memory) { return memory + waiting_at(link); }

int stewart_link_memory(const stewart_link *link)
{
    return waiting_at(link) + link->max_waiting * width(link);
}

void stewart_link_start(const stewart_link *link, double *memory)
{
    for (int i = 0; i < stewart_link_memory(link); i++)
        memory[i] = 0;
    memory[STEWART_LINK_LAST] = memory[STEWART_LINK_NEWEST] = -(double)HUGE_VAL;
}

const double *stewart_link_current(const double *memory) { return memory + STEWART_LINK_COMMANDS + 1; }

/* Let a command act, NULL for zero. It may be the current one. */
static void act(const stewart_link *link, double *memory, const double *command, double time)
{
    const size_t size = (size_t)link->size * sizeof(double);
    double *newest = acted(memory), *older = newest + 1 + link->size;
    memmove(older, newest, (size_t)((link->history - 1) * (1 + link->size)) * sizeof(double));
    newest[0] = time;
    if (command)
        memmove(newest + 1, command, size);
    else
        memset(newest + 1, 0, size);
    memory[STEWART_LINK_ACTED] += memory[STEWART_LINK_ACTED] < link->history;
}

void stewart_link_assume(const stewart_link *link, double *memory, double time,
                         const double *command)
{
    for (int i = 0; i < link->history; i++)
        act(link, memory, command, time);
}

static void drop(const stewart_link *link, double *memory, double *row)
{
    const int last = (int)--memory[STEWART_LINK_WAITING];
    memmove(row, waiting(link, memory) + width(link) * last, (size_t)width(link) * sizeof(double));
}

/* Keep a command, replacing one that can no longer act because of it. Returns 0 if the memory is
   full. */
static int keep(const stewart_link *link, double *memory, double at, double sequence, double arrival,
                const double *command)
{
    const int number = (int)memory[STEWART_LINK_WAITING];
    double *row = waiting(link, memory);
    if (!isfinite(at) || arrival == (double)HUGE_VAL) /* the plan is lost */
        return 1;
    for (int i = 0; i < number; i++, row += width(link))
        if (!link->is_wire && fabs(row[AT] - at) <= link->time_tolerance) {
            if (row[SEQUENCE] > sequence && row[ARRIVAL] <= arrival) /* this one can never act */
                return 1;
            if (row[SEQUENCE] <= sequence && row[ARRIVAL] >= arrival) /* nor can that one, from now on */
                break;
        }
    if (row == waiting(link, memory) + width(link) * number) {
        if (number == link->max_waiting)
            return 0;
        memory[STEWART_LINK_WAITING]++;
    }
    row[AT] = at;
    row[SEQUENCE] = sequence;
    row[ARRIVAL] = arrival;
    for (int i = 0; i < link->size; i++) {
        const double limit = (double)link->limit, value = command[i];
        row[COMMAND + i] = value > limit ? limit : value < -limit ? -limit : value;
    }
    return 1;
}

void stewart_link_preload(const stewart_link *link, double *memory, double first, int number,
                          const double *commands)
{
    for (int i = 0; i < number; i++)
        keep(link, memory, first + i * link->period, i - number + 1 /* <= 0 */, -(double)HUGE_VAL,
             commands + link->size * i);
}

int stewart_link_take(const stewart_link *link, double *memory, double now, double sequence,
                      double arrival, double first, int number, const double *commands)
{
    const double last = first + (number - 1) * link->period;
    if (memory[STEWART_LINK_WAITING] + (link->is_wire ? 1 : number) > link->max_waiting)
        return STEWART_LINK_NO_ROOM;
    memory[STEWART_LINK_OFFERED]++;
    if (number == 0)
        return STEWART_LINK_ACCEPTED;
    if (link->is_wire) {
        if (sequence < memory[STEWART_LINK_NEWEST])
            return STEWART_LINK_TOO_LATE;
        keep(link, memory, first, sequence, arrival, commands);
        return STEWART_LINK_ACCEPTED;
    }
    if (last < now - link->time_tolerance || last <= memory[STEWART_LINK_LAST] + link->time_tolerance)
        return STEWART_LINK_TOO_LATE;
    for (int i = 0; i < number; i++) {
        const double at = first + i * link->period;
        if (at > memory[STEWART_LINK_LAST] + link->time_tolerance && at >= now - link->time_tolerance)
            keep(link, memory, at, sequence, arrival, commands + link->size * i);
    }
    return STEWART_LINK_ACCEPTED;
}

double stewart_link_next(const stewart_link *link, const double *memory)
{
    const double *row = memory + waiting_at(link);
    double next = HUGE_VAL;
    for (int i = 0; i < (int)memory[STEWART_LINK_WAITING]; i++, row += width(link))
        if (row[AT] < next)
            next = row[AT];
    if (!link->is_wire && memory[STEWART_LINK_COUNTS] > 0 &&
        memory[STEWART_LINK_LAST] + link->period < next)
        next = memory[STEWART_LINK_LAST] + link->period;
    return next;
}

/* The newest command that is due and has arrived acts. In a buffer it must be due in this very period.
   On a wire an overtaken command never acts. All other due commands are dropped. */
void stewart_link_change(const stewart_link *link, double *memory, double time)
{
    const double until = time + link->time_tolerance;
    const double from = link->is_wire ? -(double)HUGE_VAL : time - link->time_tolerance;
    double *row = waiting(link, memory), *best = NULL;
    for (int i = 0; i < (int)memory[STEWART_LINK_WAITING]; i++, row += width(link))
        if (row[AT] >= from && row[AT] <= until && row[ARRIVAL] <= until &&
            !(best && best[SEQUENCE] > row[SEQUENCE]))
            best = row;
    memory[STEWART_LINK_LAST] = time;
    if (best && !(link->is_wire && best[SEQUENCE] < memory[STEWART_LINK_NEWEST])) {
        act(link, memory, best + COMMAND, best[AT]);
        memory[STEWART_LINK_NEWEST] = best[SEQUENCE];
        memory[STEWART_LINK_FED] = best[SEQUENCE] > 0; /* else it was preloaded */
        memory[STEWART_LINK_PLAYED] += best[SEQUENCE] > 0;
        memory[STEWART_LINK_SUPPLIED] = time + link->period;
    } else if (!link->is_wire) {
        memory[STEWART_LINK_DRY]++;
        memory[STEWART_LINK_FED] = 0;
        act(link, memory, link->hold_when_dry ? stewart_link_current(memory) : NULL, time);
    }
    memory[STEWART_LINK_COUNTS] = 1;
    for (int i = (int)memory[STEWART_LINK_WAITING] - 1; i >= 0; i--) {
        row = waiting(link, memory) + width(link) * i;
        if (row[AT] <= until)
            drop(link, memory, row);
    }
}

void stewart_link_reset(const stewart_link *link, double *memory, double time, int holds, int keeps)
{
    memory[STEWART_LINK_COUNTS] = memory[STEWART_LINK_FED] = 0;
    if (!keeps) {
        memory[STEWART_LINK_WAITING] = 0;
        memory[STEWART_LINK_NEWEST] = -(double)HUGE_VAL; /* a new session counts anew */
    }
    if (time > memory[STEWART_LINK_LAST])
        memory[STEWART_LINK_LAST] = time;
    if (acted(memory)[0] != time)
        act(link, memory, holds ? stewart_link_current(memory) : NULL, time);
    else if (!holds) /* a torque set at this instant has not acted */
        memset(acted(memory) + 1, 0, (size_t)link->size * sizeof(double));
}
