/* The configuration of one controller. */

#ifndef STEWART_CONFIG_H
#define STEWART_CONFIG_H

#include "@HEADER@"

#define STEWART_MEMORY @MEMORY@ /* numbers of the state that the law keeps between samples */
#define STEWART_SCRATCH @SCRATCH@ /* numbers of the workspace of a step */
#define STEWART_MEASURED @MEASURED@ /* numbers of a measurement */
#define STEWART_PREVIEW @ROWS@ /* largest number of instants of a preview */

extern const @KIND@ stewart_configuration;
extern const real stewart_queue[]; /* @QUEUE_MEANING@ */
extern const int stewart_queue_rows;
@TUNER_DECLARATION@
#endif
