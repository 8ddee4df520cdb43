/* A channel of packets: each sample sends a plan, and the buffer at the machine plays what arrives. */

#include "law.h"
#include "short.h"

static int network_memory(const stewart_law *law) { return stewart_packets_memory(law->packets); }

static int network_torques(const stewart_law *law) { return law->packets->torques; }

static int network_scratch(const stewart_law *law)
{
    const int planning = U * law->packets->torques + 2 * (X + U + 1) + X * (X + U + 2) +
                         stewart_linearize_scratch();
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

/* Plan the torques (N, 6) of this sample and of further ones: the model continues from the end of the
   prediction, under feedback with the same gain. */
static void plan_ahead(const stewart_law *law, const stewart_outlook *outlook, const stewart_ahead *ahead,
                       const real *newest, real *plan, stewart_scratch scratch)
{
    const int nodes = 2 * (3 + outlook->pending), pending = outlook->pending;
    real *A = stewart_take(&scratch, X * X), *B = stewart_take(&scratch, X * U);
    real flying[2][U], state[X], error[X], integral[6], before[X], ends[2][X];
    const real *rows = ahead->rows;
    stewart_copy(U, ahead->limited, plan);
    stewart_copy(X, ahead->state, state);
    stewart_copy(X, ahead->error, error);
    stewart_copy(6, ahead->integral, integral);
    stewart_copy(U, newest, flying[0]);
    for (int k = 1; k < law->packets->torques; k++, rows += ROW * (1 + nodes)) {
        real *torque = plan + U * k;
        stewart_scratch rest = scratch;
        stewart_held held;
        stewart_copy(U, torque - U, flying[pending]);
        const stewart_schedule schedule = stewart_schedule_of(law, 1, flying[0], &rest);
        stewart_predict(&law->machine, ahead->theta, &schedule, state, ends[0]);
        stewart_copy(X, ends[schedule.number - 1], state);
        stewart_copy(U, flying[pending], flying[0]); /* still to act, where a part of it is */
        stewart_copy(X, error, before);
        for (int i = 0; i < X; i++)
            error[i] = state[i] - rows[i];
        if (!stewart_at_limit(&law->machine, schedule.number, schedule.torques))
            for (int i = 0; i < 6; i++)
                integral[i] += law->period / 2 * (before[i] + error[i]);
        stewart_hold(&law->machine, &law->cost, ahead->theta, pending, rows + ROW, &held);
        stewart_copy(U, held.torque[pending], torque);
        stewart_copy(X, error, before); /* without what held torques put there */
        if (ahead->gain && !stewart_linearize(&law->machine, ahead->theta, law->period, outlook->fraction,
                                              state, &held, A, B, before, rest))
            stewart_feed_back(&law->cost, ahead->gain, before, integral, pending ? flying[0] : NULL,
                              &held, torque);
        if (stewart_all_finite(U, torque))
            stewart_limit(&law->machine, torque, torque);
        else
            stewart_copy(U, torque - U, torque);
    }
}

static void network_send(const stewart_law *law, real *memory, const stewart_outlook *outlook,
                         const stewart_ahead *ahead, const real *in_flight, stewart_scratch scratch)
{
    const int number = law->layout.in_flight.rows;
    real *plan = stewart_take(&scratch, U * law->packets->torques);
    plan_ahead(law, outlook, ahead, in_flight + U * (number - 1), plan, scratch);
    stewart_packets_send(law->packets, memory, plan, number, in_flight);
}

const stewart_channel stewart_network = {network_memory, network_scratch, network_torques,
                                         network_start,  network_update,  network_send};
