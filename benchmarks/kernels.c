/* The equations of kinematic_kf and dynamic_ekf (Dugoff tyres) written in C, for `speed_kernels.py` to compare with.

   sample: vx ax ay yaw_rate steer steer_rear fxf fxr vx_held steer_held, then seven that are not used here.
   out: beta, its standard deviation, NIS, two innovations. Parameters come in the order of the Python tuples. */

#include <math.h>

#define WIDTH 17
#define GATE 3.0
#define G 9.81
#define MOST_BETA (80.0 * 3.14159265358979323846 / 180.0)
#define REST_STD (2.0 * 3.14159265358979323846 / 180.0)

typedef struct { double mass, inertia, a, b, cf, cr, friction, height; } car_t;
typedef struct { double accel, ay_scale, speed, bias, bias_time, rolling, rear_slip, disagreement, demand, missing; } kf_noise;
typedef struct { double yaw_acceleration, slip_rate, yaw_rate, ay, missing_steer; } ekf_noise;

static inline double clamp(double x, double low, double high) { return fmin(fmax(x, low), high); }

static inline double rolling_beta(const double *s, const car_t *c)
{
    double curvature = (tan(s[4]) - tan(s[5])) / (c->a + c->b);
    return atan(c->b * curvature + tan(s[5]));
}

/* Low speed and the first sample above it; 1 where the answer is that of rolling. */
static inline int at_rest(int *running, const double *s, const car_t *c, double *out)
{
    int slow = !(s[0] > GATE);
    if (!slow && *running) return 0;
    out[0] = rolling_beta(s, c);
    out[1] = REST_STD;
    out[2] = out[3] = out[4] = NAN;
    *running = !slow;
    return 1;
}

/* Kinematic Kalman filter: vx, vy, biases of ax and ay. */

typedef struct { double m[4], p[4][4]; } kf_t;

static inline void mirror(kf_t *f)
{
    for (int i = 0; i < 4; i++)
        for (int j = 0; j < i; j++) f->p[i][j] = f->p[j][i];
}

static inline void drift(kf_t *f, const kf_noise *n, double dt)
{
    double keep = exp(-dt / n->bias_time), added = n->bias * n->bias * (1.0 - keep * keep);
    for (int i = 2; i < 4; i++) {
        f->m[i] *= keep;
        for (int j = 0; j < 2; j++) f->p[j][i] *= keep;
        f->p[i][i] = keep * keep * f->p[i][i] + added;
    }
    f->p[2][3] *= keep * keep;
    mirror(f);
}

static inline double update(kf_t *f, double h0, double h1, double off, double r)
{
    double g[4], k[4], e[4], projected, per_s;
    for (int i = 0; i < 4; i++) g[i] = f->p[i][0] * h0 + f->p[i][1] * h1;
    projected = h0 * g[0] + h1 * g[1];
    per_s = 1.0 / (projected + r);
    for (int i = 0; i < 4; i++) {
        k[i] = g[i] * per_s;
        f->m[i] += k[i] * off;
        e[i] = k[i] * r - g[i] + k[i] * projected; /* Joseph form */
    }
    for (int i = 0; i < 4; i++)
        for (int j = i; j < 4; j++) f->p[i][j] += e[j] * k[i] - k[j] * g[i];
    mirror(f);
    return off * off * per_s;
}

static inline void predict(kf_t *f, const double *s, const kf_noise *n, double dt)
{
    double ax = s[1], ay = s[2], r = s[3], felt = 1.0, density = n->accel, scaled = n->ay_scale * ay;
    if (!(fabs(ax) < 50.0 && fabs(ay) < 50.0 && fabs(r) < 10.0)) {
        ax = ay = r = felt = scaled = 0.0;
        density = n->missing;
    }
    double angle = r * dt, co = cos(angle), si = sin(angle), along, across;
    if (fabs(angle) < 1e-4) {
        along = dt * (1.0 - angle * angle / 6.0);
        across = 0.5 * dt * angle;
    } else {
        along = dt * si / angle;
        across = dt * (1.0 - co) / angle;
    }
    double x = felt * (ax - f->m[2]), y = felt * (ay - f->m[3]), vx = f->m[0], vy = f->m[1];
    f->m[0] = co * vx + si * vy + along * x + across * y;
    f->m[1] = -si * vx + co * vy - across * x + along * y;
    double t[2][4] = {{co, si, -along * felt, -across * felt}, {-si, co, across * felt, -along * felt}}, u[2][4];
    for (int i = 0; i < 2; i++)
        for (int j = 0; j < 4; j++)
            u[i][j] = t[i][0] * f->p[0][j] + t[i][1] * f->p[1][j] + t[i][2] * f->p[2][j] + t[i][3] * f->p[3][j];
    for (int i = 0; i < 2; i++) {
        for (int j = i; j < 2; j++)
            f->p[i][j] = u[i][0] * t[j][0] + u[i][1] * t[j][1] + u[i][2] * t[j][2] + u[i][3] * t[j][3];
        f->p[i][2] = u[i][2];
        f->p[i][3] = u[i][3];
    }
    f->p[0][0] += density * density * dt;
    f->p[1][1] += (density * density + scaled * scaled) * dt;
    drift(f, n, dt);
}

static inline void hold(kf_t *f)
{
    f->m[0] = fmax(f->m[0], 0.5 * GATE);
    f->m[1] = clamp(f->m[1], -tan(MOST_BETA) * f->m[0], tan(MOST_BETA) * f->m[0]);
}

static inline double roll(kf_t *f, const double *s, const car_t *c, const kf_noise *n, double dt)
{
    double ay = s[2], r = s[3];
    if (!(fabs(r) < 10.0)) {
        double off = -f->m[1];
        update(f, 0.0, 1.0, off, 100.0 / dt);
        return off;
    }
    double side = fabs(ay) < 50.0 ? ay - f->m[3] : f->m[0] * r;
    double steered = s[9] == 0.0 ? f->m[0] * (tan(s[4]) - tan(s[5])) / (c->a + c->b) : 0.0;
    double astray = (r - steered) / n->disagreement, used = side / n->demand;
    double share = exp(-astray * astray - used * used);
    if (share < 1e-3) return NAN;
    double h = -tan(s[5]), slip = n->rear_slip * side * f->m[0];
    double off = c->b * r - h * f->m[0] - f->m[1];
    update(f, h, 1.0, off, (n->rolling * n->rolling + slip * slip) / (dt * share));
    return off;
}

void kinematic(const double *samples, long count, const car_t *c, const kf_noise *n, double dt, double *out)
{
    kf_t f = {{0}, {{0}}};
    int running = 0;
    f.p[0][0] = f.p[1][1] = 1.0;
    f.p[2][2] = f.p[3][3] = n->bias * n->bias;
    for (long k = 0; k < count; k++, out += 5) {
        const double *s = samples + WIDTH * k;
        if (at_rest(&running, s, c, out)) {
            drift(&f, n, dt);
            if (!running) continue;
            f.m[0] = s[0];
            f.m[1] = s[0] * tan(out[0]);
            for (int i = 0; i < 2; i++)
                for (int j = 0; j < 4; j++) f.p[i][j] = f.p[j][i] = 0.0;
            f.p[0][0] = n->speed * n->speed;
            f.p[1][1] = s[0] * out[1] * s[0] * out[1];
            continue;
        }
        predict(&f, s, n, dt);
        out[2] = out[3] = NAN;
        if (s[8] == 0.0) {
            out[3] = s[0] - f.m[0];
            out[2] = update(&f, 1.0, 0.0, out[3], n->speed * n->speed);
        } else
            f.m[0] = fmax(f.m[0], GATE);
        hold(&f);
        out[4] = roll(&f, s, c, n, dt);
        hold(&f);
        for (int i = 2; i < 4; i++) f.m[i] = clamp(f.m[i], -6.0 * n->bias, 6.0 * n->bias);
        double x = f.m[0], y = f.m[1];
        out[0] = atan2(y, x);
        out[1] = sqrt(y * y * f.p[0][0] - 2.0 * x * y * f.p[0][1] + x * x * f.p[1][1]) / (x * x + y * y);
    }
}

/* Dynamic extended Kalman filter: yaw rate and beta. */

typedef struct { double rate[2], ay, by_r[2], by_b[2], ay_r, ay_b; } track_t;

static inline void tyre(double slip, double stiffness, double capacity, double *force, double *slope)
{
    double held = clamp(slip, -1.45, 1.45), t = tan(held), demand = stiffness * fabs(t);
    *slope = stiffness * (1.0 + t * t);
    *force = stiffness * t;
    if (demand > 0.5 * capacity) {
        double shape = 0.5 * capacity / demand;
        *force = copysign(capacity - 0.5 * capacity * shape, held);
        *slope *= shape * shape;
    }
}

static inline double capacity(double friction, double load, double fx)
{
    double all = friction * load;
    return sqrt(fmax(all * all - fx * fx, 0.01 * all * all));
}

static inline track_t single_track(double r, double beta, const double *s, const car_t *c)
{
    double vx = s[0], ax_in = isfinite(s[1]) ? s[1] : 0.0, ay_in = isfinite(s[2]) ? s[2] : 0.0;
    double weight = c->mass * G, length = c->a + c->b, moved = c->mass * ax_in * c->height;
    double load_f = fmax((weight * c->b - moved) / length, 0.05 * weight);
    double load_r = fmax((weight * c->a + moved) / length, 0.05 * weight);
    double friction = fmax(c->friction, 1.2 / G * sqrt(ax_in * ax_in + ay_in * ay_in));
    double t = tan(beta), cb = 1.0 / sqrt(1.0 + t * t), sb = t * cb;
    double front = t + c->a / vx * r, rear = t - c->b / vx * r;
    double df = -1.0 / (1.0 + front * front), dr = -1.0 / (1.0 + rear * rear);
    double fyf, fyr, slope_f, slope_r;
    tyre(s[4] - atan(front), c->cf, capacity(friction, load_f, s[6]), &fyf, &slope_f);
    tyre(s[5] - atan(rear), c->cr, capacity(friction, load_r, s[7]), &fyr, &slope_r);
    double cf = cos(s[4]), sf = sin(s[4]), cr = cos(s[5]), sr = sin(s[5]);
    double side_f = s[6] * sf + fyf * cf, side_r = s[7] * sr + fyr * cr;
    double ax = (s[6] * cf - fyf * sf + s[7] * cr - fyr * sr) / c->mass, ay = (side_f + side_r) / c->mass;
    /* how the lateral forces act, and how they change with yaw rate and beta */
    double slip_f = (cf * cb + sf * sb) * cb / (c->mass * vx), slip_r = (cr * cb + sr * sb) * cb / (c->mass * vx);
    double turn_f = c->a * cf / c->inertia, turn_r = -c->b * cr / c->inertia;
    double f_r = slope_f * df * c->a / vx, r_r = -slope_r * dr * c->b / vx;
    double f_b = slope_f * df * (1.0 + t * t), r_b = slope_r * dr * (1.0 + t * t);
    track_t o;
    o.rate[0] = (c->a * side_f - c->b * side_r) / c->inertia;
    o.rate[1] = (ay * cb - ax * sb) * cb / vx - r;
    o.ay = ay;
    o.by_r[0] = turn_f * f_r + turn_r * r_r;
    o.by_r[1] = slip_f * f_r + slip_r * r_r - 1.0;
    o.by_b[0] = turn_f * f_b + turn_r * r_b;
    o.by_b[1] = slip_f * f_b + slip_r * r_b - (2.0 * ay * sb * cb + ax * (cb * cb - sb * sb)) / vx;
    o.ay_r = (cf * f_r + cr * r_r) / c->mass;
    o.ay_b = (cf * f_b + cr * r_b) / c->mass;
    return o;
}

typedef struct { double m[2], p00, p01, p11; } ekf_t;

static inline double correct(ekf_t *f, double h0, double h1, double off, double v)
{
    double g0 = f->p00 * h0 + f->p01 * h1, g1 = f->p01 * h0 + f->p11 * h1, s = h0 * g0 + h1 * g1 + v;
    double k0 = g0 / s, k1 = g1 / s, a = 1.0 - k0 * h0, b = -k0 * h1, c = -k1 * h0, d = 1.0 - k1 * h1;
    f->m[0] += k0 * off;
    f->m[1] += k1 * off;
    double b00 = a * f->p00 + b * f->p01, b01 = a * f->p01 + b * f->p11;
    double b10 = c * f->p00 + d * f->p01, b11 = c * f->p01 + d * f->p11;
    f->p00 = b00 * a + b01 * b + k0 * k0 * v; /* Joseph form */
    f->p01 = b00 * c + b01 * d + k0 * k1 * v;
    f->p11 = b10 * c + b11 * d + k1 * k1 * v;
    return off * off / s;
}

void dynamic(const double *samples, long count, const car_t *c, const ekf_noise *n, double dt, double *out)
{
    ekf_t f = {{0.0, 0.0}, 1.0, 0.0, 1.0};
    int running = 0;
    double damping = (c->cf + c->cr) / c->mass + (c->a * c->a * c->cf + c->b * c->b * c->cr) / c->inertia;
    for (long k = 0; k < count; k++, out += 5) {
        const double *s = samples + WIDTH * k;
        if (at_rest(&running, s, c, out)) {
            f = (ekf_t){{isfinite(s[3]) ? s[3] : 0.0, out[0]}, n->yaw_rate * n->yaw_rate, 0.0, out[1] * out[1]};
            continue;
        }
        double wrong = n->missing_steer * s[9] * c->cf;
        double by_yaw = wrong * c->a / c->inertia, by_slip = wrong / (c->mass * s[0]), by_ay = wrong / c->mass;
        int steps = 1 + (int)(dt * damping / s[0]);
        double h = dt / steps;
        for (int i = 0; i < steps; i++) {
            track_t o = single_track(f.m[0], f.m[1], s, c);
            double f00 = 1.0 + h * o.by_r[0], f01 = h * o.by_b[0], f10 = h * o.by_r[1], f11 = 1.0 + h * o.by_b[1];
            f.m[0] += h * o.rate[0];
            f.m[1] = clamp(f.m[1] + h * o.rate[1], -MOST_BETA, MOST_BETA);
            double b00 = f00 * f.p00 + f01 * f.p01, b01 = f00 * f.p01 + f01 * f.p11;
            double b10 = f10 * f.p00 + f11 * f.p01, b11 = f10 * f.p01 + f11 * f.p11;
            f.p00 = b00 * f00 + b01 * f01 + h * (n->yaw_acceleration * n->yaw_acceleration + by_yaw * by_yaw);
            f.p01 = b00 * f10 + b01 * f11 + h * by_yaw * by_slip;
            f.p11 = b10 * f10 + b11 * f11 + h * (n->slip_rate * n->slip_rate + by_slip * by_slip);
        }
        track_t o = single_track(f.m[0], f.m[1], s, c);
        double r = f.m[0], beta = f.m[1], nis = NAN;
        if (isfinite(s[3])) nis = correct(&f, 1.0, 0.0, s[3] - r, n->yaw_rate * n->yaw_rate);
        if (isfinite(s[2])) {
            double off = s[2] - (o.ay + o.ay_r * (f.m[0] - r) + o.ay_b * (f.m[1] - beta));
            double part = correct(&f, o.ay_r, o.ay_b, off, n->ay * n->ay + by_ay * by_ay);
            nis = isnan(nis) ? part : nis + part;
        }
        f.m[1] = clamp(f.m[1], -MOST_BETA, MOST_BETA);
        out[0] = f.m[1];
        out[1] = sqrt(f.p11);
        out[2] = nis;
        out[3] = s[3] - r;
        out[4] = s[2] - o.ay;
    }
}
