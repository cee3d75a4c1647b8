/* The gradient of MFAILC by hand, with which `make bench` compares: for each plant, the mean
   square error of the last trial and its slopes by lam, rho, eta, mu and phi0. Laws and reset are
   those of limit.c. The trials run twice, so that not all of them must be stored: once forward,
   where the rows before each block of trials are kept, and once again block by block from the last
   one on, where the rows of every trial of the block are kept for the way back. A block has about
   the square root of all trials. On the way back each trial is one pass over its samples. */

#include <string.h>

#include "lanes.h"

struct weights { const double *a, *r, *w, *phi0; int N; };
struct slopes { vec squares, lam, rho, eta, mu, phi0[4]; };

/* The rows of a trial are `width` registers for each sample: what the scheme remembers, of which
   the last ones are the estimate. On the way back there are as many: the slopes by what it
   remembers. `trial` runs a trial from the rows `from` and writes those after it, which may be the
   same ones. `back` goes back through this trial; the first one learns nothing. */
struct law {
    int width, phi;
    void (*trial)(const struct weights *, const vec *b, int learns, const vec *from, vec *to);
    void (*back)(const struct weights *, const vec *b, int learns, const vec *from, const vec *to,
                 vec *slope, struct slopes *sum);
};

/* The slopes by the inputs of the plant from those by its outputs, one sample back. */
static inline vec step_back(vec *x, const double *a, const vec *b, vec y) {
    vec by_y = x[0] + y, by_u = b[0] * by_y + b[1] * x[1] + b[2] * x[2];
    vec before = a[0] * by_y + a[1] * x[1] + a[2] * x[2];
    x[2] = x[1], x[1] = by_y, x[0] = before;
    return by_u;
}

/* CFDL. The rows are the next input, the one before it, the output and the estimate. */
struct compact { vec u, u_last, y, phi; };

static void compact_trial(const struct weights *p, const vec *b, int learns, const vec *from,
                          vec *to) {
    const double lam = p->w[0], rho = p->w[1], eta = p->w[2], mu = p->w[3], epsilon = p->w[4];
    const struct compact *before = (const struct compact *)from;
    struct compact *after = (struct compact *)to;
    vec x[3] = {{0}};
    for (int k = 0; k < p->N; k++) {
        vec u = before[k].u, phi = before[k].phi;
        step(x, p->a, b, u);
        if (learns) {
            vec du = u - before[k].u_last, dy = x[0] - before[k].y;
            phi += eta * du / (mu + du * du) * (dy - phi * du);
            phi = choose(useless(phi, p->phi0[0], epsilon), all(p->phi0[0]), phi);
        }
        vec next = u + rho * phi / (lam + phi * phi) * (p->r[k + 1] - x[0]);
        after[k] = (struct compact){next, u, x[0], phi};
    }
}

static void compact_back(const struct weights *p, const vec *b, int learns, const vec *from,
                         const vec *to, vec *slope, struct slopes *sum) {
    const double lam = p->w[0], rho = p->w[1], eta = p->w[2], mu = p->w[3], epsilon = p->w[4];
    const struct compact *before = (const struct compact *)from, *after = (const struct compact *)to;
    struct compact *by = (struct compact *)slope;
    vec x[3] = {{0}};
    for (int k = p->N - 1; k >= 0; k--) {
        vec y = after[k].y, phi = after[k].phi, e = p->r[k + 1] - y;
        vec u = before[k].u, du = u - before[k].u_last, old = before[k].phi;
        vec size = mu + du * du, weight = lam + phi * phi, one = 1.0 / (size * weight);
        vec gain = phi * one * size; /* next = u + rho gain e */
        vec by_u = by[k].u + by[k].u_last, by_y = by[k].y - rho * gain * by[k].u;
        vec by_gain = e * by[k].u;
        sum->rho += gain * by_gain;
        by_gain *= rho * one * size;
        sum->lam -= gain * by_gain;
        vec by_phi = by[k].phi + (1.0 - 2.0 * phi * gain) * by_gain;
        vec by_du = {0}, by_dy = {0};
        if (learns) {
            vec share = one * weight, dy = y - before[k].y, miss = dy - old * du;
            vec direction = du * share; /* phi = old + eta direction miss */
            mask reset = (phi == p->phi0[0]) &
                         useless(old + eta * direction * miss, p->phi0[0], epsilon);
            sum->phi0[0] += choose(reset, by_phi, all(0.0));
            by_phi = choose(reset, all(0.0), by_phi);
            vec by_direction = by_phi * miss;
            sum->eta += direction * by_direction;
            by_direction *= eta * share;
            sum->mu -= direction * by_direction;
            by_dy = eta * direction * by_phi;
            by_du = (1.0 - 2.0 * du * direction) * by_direction - old * by_dy;
            by_phi -= du * by_dy;
        }
        by_u += by_du + step_back(x, p->a, b, by_y + by_dy);
        by[k] = (struct compact){by_u, -by_du, -by_dy, by_phi};
    }
}

/* FFDL. The rows are the input and the output of the last trial, and the estimate. */
struct full { vec u, y, phi[4]; };

static void full_trial(const struct weights *p, const vec *b, int learns, const vec *from,
                       vec *to) {
    const double lam = p->w[0], rho = p->w[1], eta = p->w[2], mu = p->w[3], epsilon = p->w[4];
    const struct full *before = (const struct full *)from;
    struct full *after = (struct full *)to;
    vec x[3] = {{0}}, h[4] = {{0}}; /* h: dy(k), dy(k-1), du(k), du(k-1) */
    for (int k = 0; k < p->N; k++) {
        struct full now = before[k];
        vec *phi = now.phi, seen = phi[0] * h[0] + phi[1] * h[1] + phi[3] * h[3];
        vec miss = p->r[k + 1] - now.y - seen;
        if (learns) h[2] = rho * phi[2] / (lam + phi[2] * phi[2]) * miss;
        now.u += h[2];
        step(x, p->a, b, now.u);
        if (learns) {
            vec dy = x[0] - now.y;
            vec size = mu + h[0] * h[0] + h[1] * h[1] + h[2] * h[2] + h[3] * h[3];
            vec gain = eta * (dy - seen - phi[2] * h[2]) / size;
            mask reset = useless(phi[2] + gain * h[2], p->phi0[2], epsilon);
            for (int i = 0; i < 4; i++) {
                phi[i] = choose(reset, all(p->phi0[i]), phi[i] + gain * h[i]);
            }
            h[1] = h[0], h[0] = dy, h[3] = h[2];
        }
        now.y = x[0];
        after[k] = now;
    }
}

static void full_back(const struct weights *p, const vec *b, int learns, const vec *from,
                      const vec *to, vec *slope, struct slopes *sum) {
    if (!learns) return; /* the first trial has the input 0 and the estimate phi0 */
    const double lam = p->w[0], rho = p->w[1], eta = p->w[2], mu = p->w[3], epsilon = p->w[4];
    const struct full *before = (const struct full *)from, *after = (const struct full *)to;
    struct full *by = (struct full *)slope;
    vec x[3] = {{0}}, by_h[4] = {{0}}; /* by_h: slopes by h as the next sample sees it */
    for (int k = p->N - 1; k >= 0; k--) {
        const vec *phi = before[k].phi;
        vec h[4] = {{0}}, none = {0};
        h[2] = after[k].u - before[k].u;
        if (k > 0) h[0] = after[k - 1].y - before[k - 1].y, h[3] = after[k - 1].u - before[k - 1].u;
        if (k > 1) h[1] = after[k - 2].y - before[k - 2].y;
        vec seen = phi[0] * h[0] + phi[1] * h[1] + phi[3] * h[3];
        vec miss = p->r[k + 1] - before[k].y - seen, dy = after[k].y - before[k].y;
        vec size = mu + h[0] * h[0] + h[1] * h[1] + h[2] * h[2] + h[3] * h[3];
        vec weight = lam + phi[2] * phi[2], one = 1.0 / (size * weight);
        vec share = one * weight, error = dy - seen - phi[2] * h[2];
        vec step = eta * error * share; /* new phi_i = phi_i + step h_i */
        mask reset = (after[k].phi[2] == p->phi0[2]) &
                     useless(phi[2] + step * h[2], p->phi0[2], epsilon);
        vec by_phi[4], by_step = {0}, now[4]; /* now: slopes by h as this sample sees it */
        for (int i = 0; i < 4; i++) {
            sum->phi0[i] += choose(reset, by[k].phi[i], none);
            by_phi[i] = choose(reset, none, by[k].phi[i]);
            by_step += h[i] * by_phi[i];
            now[i] = step * by_phi[i];
        }
        vec by_error = by_step * eta * share, by_size = -by_step * step * share;
        sum->eta += by_step * error * share;
        sum->mu += by_size;
        for (int i = 0; i < 4; i++) now[i] += 2.0 * h[i] * by_size;
        now[0] += by_h[1], now[2] += by_h[3] - phi[2] * by_error;
        by_phi[2] -= h[2] * by_error;
        vec by_dy = by_error + by_h[0], by_seen = -by_error;
        vec by_u = by[k].u + step_back(x, p->a, b, by_dy + by[k].y);
        now[2] += by_u;
        vec gain = phi[2] * one * size; /* h[2] = rho gain miss */
        vec by_gain = miss * now[2], by_miss = rho * gain * now[2];
        sum->rho += gain * by_gain;
        by_gain *= rho * one * size;
        sum->lam -= gain * by_gain;
        by_phi[2] += (1.0 - 2.0 * phi[2] * gain) * by_gain;
        by_seen -= by_miss;
        for (int i = 0; i < 4; i++) {
            if (i == 2) continue;
            by_phi[i] += h[i] * by_seen;
            now[i] += phi[i] * by_seen;
        }
        by_h[0] = now[0], by_h[1] = now[1], by_h[3] = now[3];
        by[k] = (struct full){by_u, -by_dy - by_miss,
                              {by_phi[0], by_phi[1], by_phi[2], by_phi[3]}};
    }
}

/* The gradient of LANES plants; `kept` and `rows` have room for the rows of blocks and trials. */
static void gradient(const struct law *law, const struct weights *p, const vec *b, int trials,
                     int block, vec *kept, vec *rows, vec *slope, struct slopes *sum) {
    const int y = law->width - law->phi - 1; /* place of the output in a row */
    const size_t size = (size_t)p->N * law->width, bytes = size * sizeof(vec);
    memset(sum, 0, sizeof *sum);
    memset(slope, 0, bytes);
    memset(rows, 0, bytes);
    for (size_t i = 0; i < size; i++) {
        int part = (int)(i % law->width) - y - 1;
        if (part >= 0) rows[i] = all(p->phi0[part]);
    }
    int start = (trials - 1) / block * block; /* first trial of the last block */
    for (int j = 0; j < start; j++) {
        if (j % block == 0) memcpy(kept + j / block * size, rows, bytes);
        law->trial(p, b, j > 0, rows, rows);
    }
    for (; start >= 0; start -= block) {
        int end = start + block < trials ? start + block : trials;
        if (end < trials) memcpy(rows, kept + start / block * size, bytes);
        for (int j = start; j < end; j++) {
            law->trial(p, b, j > 0, rows + (j - start) * size, rows + (j - start + 1) * size);
        }
        for (int k = 0; k < p->N && end == trials; k++) { /* the error of the last trial */
            size_t place = (size_t)k * law->width + y;
            vec e = p->r[k + 1] - rows[(end - start) * size + place];
            sum->squares += e * e;
            slope[place] = -2.0 / p->N * e;
        }
        for (int j = end - 1; j >= start; j--) {
            const vec *from = rows + (j - start) * size;
            law->back(p, b, j > 0, from, from + size, slope, sum);
        }
    }
    for (size_t i = 0; i < size; i++) {
        int part = (int)(i % law->width) - y - 1;
        if (part >= 0) sum->phi0[part] += slope[i];
    }
}

static int gradients(const struct law *law, int plants, int trials, int N, int threads,
                     const double *a, const double *b_all, const double *r, const double *w,
                     const double *phi0, double *out) {
    const struct weights p = {a, r, w, phi0, N};
    const int block = (int)ceil(sqrt(trials)), blocks = (trials + block - 1) / block;
    const size_t bytes = (size_t)N * law->width * sizeof(vec);
    int failed = 0;
#pragma omp parallel num_threads(threads) reduction(| : failed)
    {
        vec *kept = room(blocks * bytes), *slope = room(bytes);
        vec *rows = room((block + 1) * bytes);
        int none = !kept || !slope || !rows;
        failed |= none;
#pragma omp for schedule(dynamic)
        for (int first = 0; first < plants; first += LANES) {
            if (none) continue;
            vec b[3];
            struct slopes sum;
            gather(b_all, first, plants, b);
            gradient(law, &p, b, trials, block, kept, rows, slope, &sum);
            for (int l = 0; l < LANES && first + l < plants; l++) {
                double *row = out + (size_t)(first + l) * (5 + law->phi);
                row[0] = sum.squares[l] / N;
                row[1] = sum.lam[l], row[2] = sum.rho[l], row[3] = sum.eta[l], row[4] = sum.mu[l];
                for (int i = 0; i < law->phi; i++) row[5 + i] = sum.phi0[i][l];
            }
        }
        free(kept), free(slope), free(rows);
    }
    return failed;
}

int cfdl(int plants, int trials, int N, int threads, const double *a, const double *b,
         const double *r, const double *w, const double *phi0, double *out) {
    const struct law law = {4, 1, compact_trial, compact_back};
    return gradients(&law, plants, trials, N, threads, a, b, r, w, phi0, out);
}

int ffdl(int plants, int trials, int N, int threads, const double *a, const double *b,
         const double *r, const double *w, const double *phi0, double *out) {
    const struct law law = {6, 4, full_trial, full_back};
    return gradients(&law, plants, trials, N, threads, a, b, r, w, phi0, out);
}
