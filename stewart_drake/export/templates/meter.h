/* Measures each step of the replay: meter.c on a host; a board has its own. */

#pragma once

void meter_start(void);
void meter_stop(int step);
void meter_report(int steps);
