/* One sample of the recorded run, for the law that sends torques. The torques that were sent
   are passed to the controller after each sample: without a plant its rounding errors would grow. */

#define ANSWER STEWART_MOTORS

static const real weights[STEPS][2] = {
    @WEIGHTS@};
/* Torques that were sent, of this sample and of further ones. */
static const real sent[STEPS][@TORQUES@ * STEWART_MOTORS] = {
    @SENT@};
@REPORTS@
#if @MOVES@ /* the law chooses the instants of the reference */
#include "stewart_motion.h"
#else
static real preview[STEPS][STEWART_PREVIEW * STEWART_REFERENCE] = {
    @PREVIEW_ROWS@};
#endif
#if @TUNED@ /* the tuner chooses the weights */
static const real wanted[STEPS][STEWART_STATES] = {
    @WANTED@};
static real tuner_memory[STEWART_TUNER_MEMORY];
#endif

static real memory[STEWART_MEMORY], scratch[STEWART_SCRATCH];

static void begin(void)
{
    stewart_start(&stewart_configuration, memory, stewart_queue_rows, stewart_queue);
#if @TUNED@
    stewart_tuner_start(&stewart_own_tuner, tuner_memory);
#endif
}

static int answer(int k, real *torque)
{
    stewart_sample sample = {.measurement = measurement[k], .age = age[k]};
    sample.report = report_of(k);
    sample.weights[0] = weights[k][0];
    sample.weights[1] = weights[k][1];
#if @MOVES@
    double now = k * (double)stewart_configuration.period;
    sample.reference = stewart_look_ahead;
    sample.goal = stewart_look_back;
    sample.context = &now;
#else
    sample.reference = stewart_given_rows;
    sample.context = preview[k];
#endif
#if @TUNED@
    return stewart_tuned_step(&stewart_configuration, &stewart_own_tuner, memory, tuner_memory, scratch,
                              &sample, wanted[k], torque);
#else
    return stewart_step(&stewart_configuration, memory, scratch, &sample, torque);
#endif
}

static void go_on(int k)
{
    stewart_note_acted(&stewart_configuration, memory, 1, 1, sent[k]);
#if @TORQUES@ > 1 /* the plan ends the memory of the channel */
    const stewart_field channel = stewart_configuration.layout.channel;
    stewart_copy(@TORQUES@ * STEWART_MOTORS, sent[k],
                 memory + channel.at + channel.columns - @TORQUES@ * STEWART_MOTORS);
#endif
}
