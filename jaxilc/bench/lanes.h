/* LANES plants to a register: what limit.c and adjoint.c have in common. */

#include <math.h>
#include <stdlib.h>

typedef double vec __attribute__((vector_size(8 * LANES)));
typedef long long mask __attribute__((vector_size(8 * LANES)));

static inline vec all(double value) { return value - (vec){0}; }
static inline vec choose(mask m, vec a, vec b) { return (vec)((m & (mask)a) | (~m & (mask)b)); }
static inline vec magnitude(vec a) { return choose(a < 0.0, -a, a); }
static inline mask useless(vec phi, double start, double epsilon) {
    return (magnitude(phi) <= epsilon) | ((start > 0 ? phi : -phi) <= 0.0);
}

static inline void gather(const double *b, int first, int plants, vec *lanes) {
    for (int l = 0; l < LANES; l++) {
        int s = first + l < plants ? first + l : plants - 1;
        for (int i = 0; i < 3; i++) lanes[i][l] = b[3 * s + i];
    }
}

static inline void step(vec *x, const double *a, const vec *b, vec u) {
    vec y = x[0];
    x[0] = x[1] + a[0] * y + b[0] * u;
    x[1] = x[2] + a[1] * y + b[1] * u;
    x[2] = a[2] * y + b[2] * u;
}
