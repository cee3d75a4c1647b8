/* LANES plants to a register: what limit.c and adjoint.c have in common. The registers are the
   widest that the target of the compiler has. GCC 12 takes wider vectors apart number by number,
   which is 3 to 11 times as slow, and two registers of plants at a time are no faster than one. */

#include <math.h>
#include <stdlib.h>

#if defined __AVX512F__
#define INSTRUCTIONS "AVX-512"
#define LANES 8
#elif defined __AVX2__
#define INSTRUCTIONS "AVX2"
#define LANES 4
#elif defined __AVX__
#define INSTRUCTIONS "AVX"
#define LANES 4
#elif defined __SSE2__
#define INSTRUCTIONS "SSE2"
#define LANES 2
#elif defined __ARM_NEON
#define INSTRUCTIONS "NEON"
#define LANES 2
#else
#define INSTRUCTIONS "128 bits"
#define LANES 2
#endif

#ifdef __clang__
const char *const compiler = __VERSION__;
#else
const char *const compiler = "GCC " __VERSION__;
#endif
const char *const instructions = INSTRUCTIONS;
const int lanes = LANES;

typedef double vec __attribute__((vector_size(8 * LANES)));
typedef long long mask __attribute__((vector_size(8 * LANES)));

static inline void *room(size_t bytes) { return aligned_alloc(sizeof(vec), bytes); }
static inline vec all(double value) { return value - (vec){0}; }
static inline vec choose(mask m, vec a, vec b) { return (vec)((m & (mask)a) | (~m & (mask)b)); }
static inline vec magnitude(vec a) { return choose(a < 0.0, -a, a); }
static inline mask useless(vec phi, double start, double epsilon) {
    return (magnitude(phi) <= epsilon) | ((start > 0 ? phi : -phi) <= 0.0);
}

static inline void gather(const double *b, int first, int plants, vec *of_each) {
    for (int l = 0; l < LANES; l++) {
        int s = first + l < plants ? first + l : plants - 1;
        for (int i = 0; i < 3; i++) of_each[i][l] = b[3 * s + i];
    }
}

static inline void step(vec *x, const double *a, const vec *b, vec u) {
    vec y = x[0];
    x[0] = x[1] + a[0] * y + b[0] * u;
    x[1] = x[2] + a[1] * y + b[1] * u;
    x[2] = a[2] * y + b[2] * u;
}
