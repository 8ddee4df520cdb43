/* The configuration of one controller, of the scenario

@SCENARIO@
*/

#include <math.h>

#include "stewart_config.h"

const stewart_config stewart_configuration = {
    @CONFIGURATION@
};

const real stewart_queue[] = @QUEUE@;
