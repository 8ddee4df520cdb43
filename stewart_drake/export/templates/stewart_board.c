/* A simulated plate for stewart_machine.c. Each function first moves it up to the time of the call. */

#include "stewart_board.h"

#include <math.h>
#include <string.h>

#include "stewart_config.h"
#include "stewart_example.h"

#define FINEST 1000000u /* ns, a step of the equations of motion */

const uint32_t board_flags = STEWART_SIMULATION | STEWART_RESETS;

static struct {
    int free; /* brakes are off */
    uint64_t time;
    real torque[STEWART_MOTORS], state[STEWART_STATES];
    stewart_reason fault;
} plate;

/* Return how the plate left its workspace, or STEWART_NO_FAULT. */
static stewart_reason left(void)
{
    stewart_reason fault = {STEWART_NO_FAULT, 0, 0};
    real measures[STEWART_NUM_MEASURES];
    int worst = 0;
    for (int i = 0; i < STEWART_STATES; i++)
        if (!isfinite(plate.state[i]))
            fault.fault = STEWART_NOT_FINITE;
    if (fault.fault)
        return fault;
    stewart_measures(stewart_configuration.machine.geometry, plate.state, NULL, measures);
    measures[6] *= stewart_home_sign;
    for (int i = 1; i < STEWART_MOTORS; i++)
        worst = measures[i] < measures[worst] ? i : worst;
    if (!(measures[worst] > stewart_least[worst])) {
        fault.fault = STEWART_REACH;
        fault.leg = (uint8_t)(worst + 1);
    } else if (!(measures[7] > stewart_least[7])) {
        fault.fault = STEWART_PITCH;
    } else if (!(measures[6] > stewart_least[6])) {
        fault.fault = STEWART_SINGULAR;
    }
    return fault;
}

static void follow(uint64_t time)
{
    const stewart_law *c = &stewart_configuration;
    stewart_plant plant = {c->machine.geometry, c->machine.parameters, &c->machine.gravity,
                           c->machine.joints};
    real low[STEWART_STATES] = {0};
    while (plate.free && !plate.fault.fault && plate.time < time) {
        uint64_t h = time - plate.time < FINEST ? time - plate.time : FINEST;
        stewart_runge_kutta_step(&plant, plate.torque, (real)(1e-9 * (double)h), plate.state, low);
        plate.time += h;
        plate.fault = left();
    }
}

void board_park(void)
{
    memset(&plate, 0, sizeof plate);
    memcpy(plate.state, stewart_first_state, sizeof plate.state);
}

void board_release(uint64_t time)
{
    plate.free = 1;
    plate.time = time;
}

void board_drive(uint64_t time, const double *torque)
{
    follow(time);
    for (int i = 0; i < STEWART_MOTORS; i++)
        plate.torque[i] = (real)torque[i];
}

void board_measure(uint64_t time, double *state)
{
    follow(time);
    for (int i = 0; i < STEWART_STATES; i++)
        state[i] = (double)plate.state[i];
}

stewart_reason board_fault(uint64_t time, uint64_t *left_at)
{
    follow(time);
    *left_at = plate.time;
    return plate.fault;
}
