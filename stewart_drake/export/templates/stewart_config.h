/* The configuration of one controller. */

#ifndef STEWART_CONFIG_H
#define STEWART_CONFIG_H

#include "@HEADER@"

#define STEWART_MEMORY @MEMORY@   /* numbers that the law remembers */
#define STEWART_SCRATCH @SCRATCH@ /* numbers that it computes in */
#define STEWART_MEASURED @MEASURED@ /* numbers of a measurement */
#define STEWART_PREVIEW @ROWS@      /* of a preview, at the most */

extern const @KIND@ stewart_configuration;
extern const real stewart_queue[]; /* @QUEUE_MEANING@ */
extern const int stewart_queue_rows;
@TUNER_DECLARATION@
#endif
