/* What the arrays of stewart.h have place for, and whether numbers are of single precision. */

#ifndef STEWART_LIMITS_H
#define STEWART_LIMITS_H

#define STEWART_MAX_QUEUE 64 /* torques in flight at a sample: the delay in periods, rounded up */
#define STEWART_MAX_KEPT 32  /* further torques, for measurements that come late */

#endif
