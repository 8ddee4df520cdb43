/* The configuration of one controller. */

#pragma once

#include "@"tuner" if tuner else "servo" if servos else "law"@.h"

#define STEWART_MEMORY @memory@ /* numbers of the state that the law keeps between samples */
#define STEWART_SCRATCH @scratch@ /* numbers of the workspace of a step */
#define STEWART_MEASUREMENT_SIZE @sizes.num_values@ /* numbers of a measurement */
#define STEWART_LONGEST_GAP @gap@ /* s without a usable measurement, then stop safely */
#define STEWART_PREVIEW @sizes.rows@ /* largest number of instants of a preview */

extern const @"stewart_servo" if servos else "stewart_law"@ stewart_configuration;
{% if servos %}
extern const real stewart_queue[]; /* the command that was sent last */
{% else %}
extern const real stewart_queue[]; /* torques under way at the start, the oldest first */
{% endif %}
extern const int stewart_queue_rows;
{% if tuner %}
extern const stewart_tuner stewart_own_tuner;
#define STEWART_TUNER_MEMORY @tuner_memory@ /* numbers that the tuner remembers */
{% endif %}
