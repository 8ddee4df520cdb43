/* The configuration of one controller, of the scenario

@SCENARIO@
*/

#include <math.h>

#include "stewart_config.h"
@INCLUDES@

@CONSTANTS@

const @KIND@ stewart_configuration = @CONFIGURATION@;

const real stewart_queue[] = @QUEUE@;
const int stewart_queue_rows = @QUEUE_ROWS@;
@TUNER@
