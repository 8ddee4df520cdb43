/* The configuration of one controller. */

#ifndef STEWART_CONFIG_H
#define STEWART_CONFIG_H

#include "stewart.h"

extern const stewart_config stewart_configuration;
extern const real stewart_queue[]; /* torques under way at the start, the oldest first */

#endif
