{% if servos %}
/* One sample of the recorded run, for the law that sends crank angles to servos. */

#define ANSWER STEWART_COMMAND

static const real report[STEPS][@steps[0].report.size@] = {
    @steps|map(attribute="report")|rows@};
{% else %}
/* One sample of the recorded run, for the law that sends torques. The torques that were sent
   are passed to the controller after each sample: without a plant its rounding errors would grow. */

#define ANSWER STEWART_MOTORS

{% set torques = law.channel.torques %}
{% set reports = steps|selectattr("report")|list %}
static const real weights[STEPS][2] = {
    @steps|map(attribute="weights")|rows@};
/* Torques that were sent, of this sample and of further ones. */
static const real sent[STEPS][@torques@ * STEWART_MOTORS] = {
    @steps|map(attribute="sent")|rows@};
{% if reports %}
{% for step in steps %}
{% if step.report %}
static const real arrived_@loop.index0@[] = @step.report.arrived|c@;
static const real acted_@loop.index0@[] = @step.report.acted|c@;
{% endif %}
{% endfor %}
static const stewart_report reports[STEPS] = {
{% for step in steps %}
{% set k, report = loop.index0, step.report %}
    @"{0, 0, 0, 0, -1}" if not report else "{%d, arrived_%d, %d, acted_%d, %d}" % (report.arrived|length, k, report.acted|length, k, report.age)@@"," if not loop.last else "};"@
{% endfor %}
{% endif %}
{% if tuner %}
static const real wanted[STEPS][STEWART_STATES] = {
    @wanted|rows@};
static real tuner_memory[STEWART_TUNER_MEMORY];
{% endif %}
{% endif %}
{% if moves %}
#include "stewart_motion.h"

/* Period of the recorded run, s. It is 1e-14 of itself short: samples came just before the plant's step of the same
   time, and a motion that jumps there is read before the jump. */
#define SAMPLED @sampled|float@
{% else %}
static real preview[STEPS][@"STEWART_PREVIEW * " if not servos@STEWART_REFERENCE] = {
    @steps|map(attribute="preview")|rows@};
{% endif %}

static real memory[STEWART_MEMORY], scratch[STEWART_SCRATCH];

static void begin(void)
{
{% if servos %}
    stewart_servo_start(&stewart_configuration, memory, stewart_queue);
{% else %}
    stewart_start(&stewart_configuration, memory, stewart_queue_rows, stewart_queue);
{% endif %}
{% if tuner %}
    stewart_tuner_start(&stewart_own_tuner, tuner_memory);
{% endif %}
}

static int answer(int k, real *found)
{
    stewart_sample sample = {.measurement = measurement[k], .age = age[k]};
{% if moves %}
    double now = k * SAMPLED;
    sample.reference = stewart_look_ahead;
    sample.goal = stewart_look_back;
    sample.context = &now;
{% else %}
    sample.reference = stewart_given_rows;
    sample.context = preview[k];
{% endif %}
{% if servos %}
    return stewart_servo_step(&stewart_configuration, memory, scratch, &sample, report[k], found);
{% else %}
{% if reports %}
    sample.report = reports[k].age < 0 ? NULL : &reports[k];
{% endif %}
    sample.weights[0] = weights[k][0];
    sample.weights[1] = weights[k][1];
{% if tuner %}
    return stewart_tuned_step(&stewart_configuration, &stewart_own_tuner, memory, tuner_memory, scratch,
                              &sample, wanted[k], found);
{% else %}
    return stewart_step(&stewart_configuration, memory, scratch, &sample, found);
{% endif %}
{% endif %}
}

static void after_step(int k)
{
{% if servos %}
    (void)k;
{% else %}
    stewart_note_acted(&stewart_configuration, memory, 1, 1, sent[k]);
{% if torques > 1 %}
    /* The plan ends the memory of the channel. */
    const stewart_field channel = stewart_configuration.layout.channel;
    stewart_copy(@torques@ * STEWART_MOTORS, sent[k],
                 memory + channel.at + channel.columns - @torques@ * STEWART_MOTORS);
{% endif %}
{% endif %}
}
