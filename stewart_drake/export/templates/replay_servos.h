/* One sample of the recorded run, for the law that sends crank angles to servos. */

#define ANSWER STEWART_COMMAND

static const real report[STEPS][@REPORT_SIZE@] = {
    @SERVO_REPORTS@};
static real preview[STEPS][STEWART_REFERENCE] = {
    @PREVIEW_ROWS@};
static real memory[STEWART_MEMORY], scratch[STEWART_SCRATCH];

static void begin(void)
{
    stewart_servo_start(&stewart_configuration, memory, stewart_queue);
}

static int answer(int k, real *command)
{
    stewart_sample sample = {.measurement = measurement[k], .age = age[k]};
    sample.reference = stewart_given_rows;
    sample.context = preview[k];
    return stewart_servo_step(&stewart_configuration, memory, scratch, &sample, report[k], command);
}

static void go_on(int k) { (void)k; }
