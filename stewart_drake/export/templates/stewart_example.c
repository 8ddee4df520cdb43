/* Data of the scenario for the examples over UDP. */

#include "stewart_example.h"

const real stewart_weights[2] = @OWN_WEIGHTS@;
const real stewart_first_state[STEWART_STATES] = @START@;
const real stewart_least[STEWART_MEASURES] = @LEAST@;
const real stewart_home_sign = @HOME_SIGN@;
const stewart_identity stewart_own_identity = {{
    @IDENTITY@}};
const char *const stewart_faults[STEWART_FAULTS] = {
    @FAULTS@};
