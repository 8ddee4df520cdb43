/* What the replay measures around each step. meter.c does so on a host; a board brings its own. */

#ifndef METER_H
#define METER_H

void meter_start(void);
void meter_stop(int step);
void meter_report(int steps);

#endif
