/* The configuration of one controller, of the scenario below. Its files are named without their folders.

@scenario_yaml@
*/

#include <math.h>

#include "stewart_config.h"
{% for name in headers %}
#include "@name@"
{% endfor %}

@configuration.before|join("\n")@

const @"stewart_servo" if servos else "stewart_law"@ stewart_configuration = @configuration.text@;

const real stewart_queue[] = @(queue if queue.size else [0.0])|c@;
const int stewart_queue_rows = @queue|length if queue.size else 0@;
{% if tuner %}

{% for line in tuner.before %}
@line@
{% endfor %}
const stewart_tuner stewart_own_tuner = @tuner.text@;
{% endif %}
