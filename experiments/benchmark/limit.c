/* MFAILC on a difference equation of third order, LANES plants to a register: the limit that
   `make bench` compares with. Laws, reset and metrics are those of peers.py. Each trial is one
   pass over its samples, in place, so that a tile of plants stays in the cache. */

#include "lanes.h"

static inline vec larger(vec a, vec b) { return choose(a > b, a, b); }

struct metrics { vec largest, squares, late, effort; };

static inline void judge(struct metrics *f, vec e, vec u, int settled) {
    vec size = magnitude(e);
    f->largest = larger(size, f->largest);
    f->squares += e * e;
    f->effort += u * u;
    if (settled) f->late = larger(size, f->late);
}

static void keep(const struct metrics *f, int j, int first, int plants, int trials, int N,
                 double *out) {
    for (int l = 0; l < LANES && first + l < plants; l++) {
        double *row = out + ((size_t)(first + l) * trials + j) * 4;
        row[0] = f->largest[l];
        row[1] = sqrt(f->squares[l] / N);
        row[2] = f->late[l];
        row[3] = sqrt(f->effort[l] / N);
    }
}

int cfdl(int plants, int trials, int N, int settled, int threads, const double *a,
         const double *b_all, const double *r, const double *w, const double *phi0, double *out) {
    const double lam = w[0], rho = w[1], eta = w[2], mu = w[3], epsilon = w[4];
    int failed = 0;
#pragma omp parallel num_threads(threads) reduction(| : failed)
    {
        struct row { vec u, u_last, y, phi; } *rows = room((size_t)N * sizeof *rows);
        failed |= rows == NULL;
#pragma omp for schedule(dynamic)
        for (int first = 0; first < plants; first += LANES) {
            if (!rows) continue;
            vec b[3];
            gather(b_all, first, plants, b);
            for (int k = 0; k < N; k++) rows[k] = (struct row){.phi = all(phi0[0])};
            for (int j = 0; j < trials; j++) {
                vec x[3] = {{0}};
                struct metrics f = {{0}};
                for (int k = 0; k < N; k++) {
                    struct row *now = rows + k;
                    vec u = now->u, phi = now->phi;
                    step(x, a, b, u);
                    vec e = r[k + 1] - x[0];
                    judge(&f, e, u, k + 1 >= settled);
                    if (j) {
                        vec du = u - now->u_last, dy = x[0] - now->y;
                        phi += eta * du / (mu + du * du) * (dy - phi * du);
                        phi = choose(useless(phi, phi0[0], epsilon), all(phi0[0]), phi);
                    }
                    *now = (struct row){u + rho * phi / (lam + phi * phi) * e, u, x[0], phi};
                }
                keep(&f, j, first, plants, trials, N, out);
            }
        }
        free(rows);
    }
    return failed;
}

int ffdl(int plants, int trials, int N, int settled, int threads, const double *a,
         const double *b_all, const double *r, const double *w, const double *phi0, double *out) {
    const double lam = w[0], rho = w[1], eta = w[2], mu = w[3], epsilon = w[4];
    int failed = 0;
#pragma omp parallel num_threads(threads) reduction(| : failed)
    {
        struct row { vec u, y, phi[4]; } *rows = room((size_t)N * sizeof *rows);
        failed |= rows == NULL;
#pragma omp for schedule(dynamic)
        for (int first = 0; first < plants; first += LANES) {
            if (!rows) continue;
            vec b[3];
            gather(b_all, first, plants, b);
            for (int k = 0; k < N; k++) {
                vec start[4] = {all(phi0[0]), all(phi0[1]), all(phi0[2]), all(phi0[3])};
                rows[k] = (struct row){.phi = {start[0], start[1], start[2], start[3]}};
            }
            for (int j = 0; j < trials; j++) {
                vec x[3] = {{0}}, h[4] = {{0}}; /* h: dy(k), dy(k-1), du(k), du(k-1) */
                struct metrics f = {{0}};
                for (int k = 0; k < N; k++) {
                    struct row *now = rows + k;
                    vec *phi = now->phi, seen = phi[0] * h[0] + phi[1] * h[1] + phi[3] * h[3];
                    vec miss = r[k + 1] - now->y - seen;
                    if (j) h[2] = rho * phi[2] / (lam + phi[2] * phi[2]) * miss;
                    vec u = now->u + h[2];
                    step(x, a, b, u);
                    judge(&f, r[k + 1] - x[0], u, k + 1 >= settled);
                    if (j) {
                        vec dy = x[0] - now->y;
                        vec size = mu + h[0] * h[0] + h[1] * h[1] + h[2] * h[2] + h[3] * h[3];
                        vec gain = eta * (dy - seen - phi[2] * h[2]) / size;
                        mask reset = useless(phi[2] + gain * h[2], phi0[2], epsilon);
                        for (int i = 0; i < 4; i++) {
                            phi[i] = choose(reset, all(phi0[i]), phi[i] + gain * h[i]);
                        }
                        h[1] = h[0], h[0] = dy, h[3] = h[2];
                    }
                    now->u = u, now->y = x[0];
                }
                keep(&f, j, first, plants, trials, N, out);
            }
        }
        free(rows);
    }
    return failed;
}
