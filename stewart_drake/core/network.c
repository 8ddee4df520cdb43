/* A channel of packets: each sample sends a plan, and the buffer at the machine plays what arrives. */

#include <string.h>

#include "law.h"
#include "short.h"

int stewart_planning_scratch(const stewart_law *law)
{
    const int most_pending = law->design ? law->layout.in_flight.rows : 1;
    return 2 * U * (1 + most_pending) + 2 * (X + U + 1) + X * (X + U) + stewart_linearize_scratch();
}

void stewart_plan_torques(const stewart_law *law, const stewart_outlook *outlook,
                          const stewart_predicted *ahead, const real *pending_torques, real *plan,
                          stewart_scratch scratch)
{
    const int pending = outlook->pending, nodes = 2 * (3 + pending);
    const int torques = law->channel->torques(law);
    real *flying = stewart_take(&scratch, U * (1 + pending));
    real *feedforward = stewart_take(&scratch, U * (1 + pending));
    real state[X], error[X], integral[6], before[X], ends[2][X];
    const real *rows = ahead->rows;
    stewart_copy(U, ahead->limited, plan);
    stewart_copy(X, ahead->state, state);
    stewart_copy(X, ahead->error, error);
    stewart_copy(6, ahead->integral, integral);
    stewart_copy(U * pending, pending_torques, flying);
    for (int k = 1; k < torques; k++, rows += ROW * (1 + nodes)) {
        real *torque = plan + U * k;
        stewart_scratch rest = scratch;
        stewart_copy(U, torque - U, flying + U * pending);
        const stewart_schedule schedule =
            stewart_schedule_of(law->period, outlook->fraction, 1, flying, &rest);
        stewart_predict(&law->machine, ahead->theta, &schedule, state, NULL, ends[0]);
        stewart_copy(X, ends[schedule.number - 1], state);
        memmove(flying, flying + U, (size_t)(U * pending) * sizeof(real)); /* still to act */
        stewart_copy(X, error, before);
        for (int i = 0; i < X; i++)
            error[i] = state[i] - rows[i];
        if (!stewart_at_limit(&law->machine, schedule.number, schedule.torques))
            for (int i = 0; i < 6; i++)
                integral[i] += law->period / 2 * (before[i] + error[i]);
        stewart_copy(X, error, before); /* then less the offset that held torques cause */
        const int failure =
            stewart_design_feedback(law, outlook, ahead->theta, rows + ROW, state, NULL, feedforward,
                                    ahead->gain ? before : NULL, NULL, rest);
        stewart_copy(U, feedforward + U * pending, torque);
        if (ahead->gain && !failure)
            stewart_feed_back(&law->cost, ahead->gain, before, integral, pending, flying, feedforward,
                              torque);
        if (stewart_all_finite(U, torque))
            stewart_limit(&law->machine, torque, torque);
        else
            stewart_copy(U, torque - U, torque);
    }
}

static int network_memory(const stewart_law *law) { return stewart_packets_memory(law->packets); }

static int network_torques(const stewart_law *law) { return law->packets->torques; }

static int network_scratch(const stewart_law *law)
{
    const int planning = U * law->packets->torques + stewart_planning_scratch(law);
    const int updating = stewart_packets_scratch(law->packets);
    return planning > updating ? planning : updating;
}

static void network_start(const stewart_law *law, real *memory)
{
    stewart_packets_start(law->packets, memory);
}

static void network_update(const stewart_law *law, real *memory, const stewart_report *report,
                           real *in_flight, stewart_scratch scratch)
{
    stewart_packets_update(law->packets, memory, report, law->steps, law->layout.in_flight.rows,
                           in_flight, scratch);
}

static void network_send(const stewart_law *law, real *memory, const stewart_outlook *outlook,
                         const stewart_predicted *ahead, const real *in_flight, stewart_scratch scratch)
{
    const int number = law->layout.in_flight.rows;
    real *plan = stewart_take(&scratch, U * law->packets->torques);
    stewart_plan_torques(law, outlook, ahead, in_flight + U * (number - outlook->pending), plan, scratch);
    stewart_packets_send(law->packets, memory, plan, number, in_flight);
}

const stewart_channel stewart_network = {network_memory, network_scratch, network_torques,
                                         network_start,  network_update,  network_send};
