/* Data of the scenario for the examples over UDP. */

#include "stewart_example.h"

const uint64_t stewart_period = @(1e9 * scenario.controller.period)|round|int@;
const real stewart_weights[2] = @scenario.controller.weights|c@;
const real stewart_first_state[STEWART_STATES] = @experiment.start|c@;
const real stewart_least[STEWART_NUM_MEASURES] = @least|c@;
const real stewart_home_sign = @home_sign|c@;
const stewart_identity stewart_own_identity = {{
{% for part in identity %}
    {{@part.digest|map("string")|join(", ")@}, "@part.name@"}@"," if not loop.last else "}};"@
{% endfor %}
const char *const stewart_faults[STEWART_FAULTS] = {
{% for words in faults %}
    "@words|replace("{:", "%")|replace("}", "")@"@"," if not loop.last else "};"@
{% endfor %}
