#include "measurement.h"
#include "short.h"

#define SMALL_CORRECTION ((real)0.1) /* standard deviations; a shorter correction ends the iterations */

void stewart_predict_measurement(const stewart_sensing *sensing, const real *state, real *predicted)
{
    if (sensing->seen)
        sensing->seen(sensing, state, predicted);
    else
        stewart_copy(X, state, predicted);
}

void stewart_measurement_jacobian(const stewart_sensing *sensing, const real *state, real *J)
{
    if (sensing->jacobian)
        sensing->jacobian(sensing, state, J);
}

void stewart_apply_jacobian(const stewart_sensing *sensing, const real *J, int k, const real *A,
                            real *JA)
{
    if (sensing->jacobian) {
        stewart_multiply_by_transpose(sensing->size, X, k, J, A, JA);
        return;
    }
    for (int i = 0; i < X; i++) /* J = 1 */
        for (int j = 0; j < k; j++)
            JA[k * i + j] = A[X * j + i];
}

int stewart_innovation_root(const stewart_sensing *sensing, const real *state, int k, const real *A,
                            const real *std, real *C, stewart_scratch scratch)
{
    const int m = sensing->size;
    real *J = stewart_take(&scratch, m * X), *JA = stewart_take(&scratch, m * k);
    stewart_measurement_jacobian(sensing, state, J);
    stewart_apply_jacobian(sensing, J, k, A, JA);
    stewart_multiply_by_transpose(m, k, m, JA, JA, C);
    for (int i = 0; i < m; i++) {
        for (int j = 0; j <= i; j++)
            for (int l = 0; l < X && sensing->jacobian; l++)
                C[m * i + j] += J[X * i + l] * std[l] * std[l] * J[X * j + l];
        if (!sensing->jacobian) /* J = 1 */
            C[(m + 1) * i] += std[i] * std[i];
        C[(m + 1) * i] += sensing->noise_std[i] * sensing->noise_std[i];
    }
    return stewart_cholesky(m, C);
}

void stewart_whiten(int m, int n, const real *C, real *B)
{
    for (int i = 0; i < m; i++) {
        real *row = B + n * i;
        for (int k = 0; k < i; k++) {
            const real c = C[m * i + k];
            for (int j = 0; j < n && c != 0; j++) /* C of a measured state is nearly diagonal */
                row[j] -= c * B[n * k + j];
        }
        for (int j = 0; j < n; j++)
            row[j] /= C[(m + 1) * i];
    }
}

void stewart_whitened_derivative(const stewart_measurement *a, real *H)
{
    const int m = a->sensing->size;
    if (a->sensing->jacobian)
        stewart_multiply(m, X, a->n, a->J, a->H, H);
    else
        stewart_copy(X * a->n, a->H, H);
    stewart_whiten(m, a->n, a->C, H);
}

int stewart_measurement_residuals(void *context, const real *xi, real *e, real *H, stewart_scratch scratch)
{
    const stewart_measurement *a = context;
    const int m = a->sensing->size;
    (void)xi;
    (void)scratch;
    stewart_predict_measurement(a->sensing, a->state, e);
    stewart_measurement_jacobian(a->sensing, a->state, a->J);
    stewart_whitened_derivative(a, H);
    for (int i = 0; i < m; i++)
        e[i] = a->values[i] - e[i];
    stewart_whiten(m, 1, a->C, e);
    return m;
}

/* Whether a change of the state changes each predicted value by less than SMALL_CORRECTION. */
static int is_small(const stewart_measurement *a, const real *change, stewart_scratch scratch)
{
    const int m = a->sensing->size;
    real *change_of_values = stewart_take(&scratch, m);
    stewart_apply_jacobian(a->sensing, a->J, 1, change, change_of_values);
    for (int i = 0; i < m; i++) {
        real variance = 0; /* (C C')_ii */
        for (int j = 0; j <= i; j++)
            variance += a->C[m * i + j] * a->C[m * i + j];
        if (!(REAL(fabs)(change_of_values[i]) <= SMALL_CORRECTION * REAL(sqrt)(variance))) /* or NaN */
            return 0;
    }
    return 1;
}

/* End the iterations, with the linearised prediction, if the correction changes it little. Otherwise predict again,
   and end them if that agrees with the linearised prediction: the old H then holds at `updated`, too. */
int stewart_measurement_relinearize(void *context, const real *change, const real *updated,
                                    stewart_scratch scratch)
{
    const stewart_measurement *a = context;
    real shift[X], linearised[X], none[X] = {0};
    for (int i = 0; i < X; i++) {
        shift[i] = 0;
        for (int j = 0; j < a->n; j++)
            shift[i] += a->H[a->n * i + j] * change[j];
        linearised[i] = a->state[i] + shift[i];
    }
    if (is_small(a, shift, scratch)) {
        stewart_accumulate(X, shift, a->state, a->low ? a->low : none);
        return 1;
    }
    if (!a->predict(a->context, updated, a->state))
        return -1;
    for (int i = 0; i < X; i++)
        shift[i] = a->state[i] - linearised[i];
    stewart_measurement_jacobian(a->sensing, a->state, a->J);
    if (is_small(a, shift, scratch))
        return 1;
    return a->linearize(a->context, updated, a->H, scratch) ? 0 : -1;
}
