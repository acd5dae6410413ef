/* The plant of YawFusion-v0 in plain C: the yardstick that ours is measured against.
 *
 * One tick is what `plant.py` compiles: the actuators' lag, two loads, Fiala tyres, roll, and
 * Kutta's third-order rule on the velocities, place and heading once at the end: the fastest way
 * we know to that error, operation by operation in the order of `envs`. Blocks of cars,
 * structures of arrays, so that the compiler makes vectors of it; BLOCK, the cars in one, is a
 * macro of its command line. Constants of a call are computed once a block. What the id's cars and
 * roads do not have is left out: load that moves between the axles, roads laid tick by tick, waves
 * of bank.
 *
 * Compiled with -O3 -march=native -ffp-contract=off; more flags stand in `plant.py`.
 */
#include <math.h>
#include <string.h>

#define INLINE static inline __attribute__((always_inline))

/* Fields in the order of the arrays (blocks, fields, BLOCK). */
#define CAR(DO) \
    DO(m) DO(I) DO(l_f) DO(l_r) DO(C_f) DO(C_r) DO(d_f) DO(d_r) DO(r) DO(T_max) DO(mu) DO(l_pre) \
    DO(S) DO(I_x) DO(K_x) DO(C_x) DO(h) DO(ahead) DO(left) DO(mu_r) \
    DO(P) DO(h_x) DO(k_l) DO(k_r) DO(relaxation)
#define ROAD(DO) DO(curvature) DO(start) DO(ramp) DO(across) DO(along) DO(turn) \
    DO(wave) DO(wave_rate) DO(wave_phase)
#define PUSH(DO) DO(F_d) DO(N_d) DO(N_x)
#define INPUTS(DO) DO(delta) DO(T_l) DO(T_r)
#define MOTION(DO) \
    DO(v_x) DO(v_y) DO(gamma) DO(psi) DO(X) DO(Y) DO(s) DO(y) DO(theta) DO(phi) DO(phi_dot) \
    DO(slip_f) DO(slip_r)
#define VELOCITY(DO) DO(v_x) DO(v_y) DO(gamma) DO(phi) DO(phi_dot)
#define COURSE(DO) DO(X) DO(Y) DO(s) DO(y) DO(theta)
/* Constants of a car. */
#define FIXED(DO) \
    DO(per_m) DO(per_I) DO(front) DO(rear_l) DO(rear_r) DO(slope_f) DO(per_front) DO(per_rear) \
    DO(direct) DO(per_lean) DO(per_r) DO(per_ramp) DO(half_track)
#define LOAD(DO) DO(sin_d) DO(cos_d) DO(F_l) DO(F_r)

#define DOUBLE(k) double k;
#define IN_BLOCK(k) double k[BLOCK];
typedef struct { CAR(DOUBLE) } car;
typedef struct { ROAD(DOUBLE) } road;
typedef struct { PUSH(DOUBLE) } push;
typedef struct { INPUTS(DOUBLE) } inputs;
typedef struct { MOTION(DOUBLE) } motion;
typedef struct { FIXED(DOUBLE) } fixed;
typedef struct { LOAD(DOUBLE) } load;
typedef struct { VELOCITY(DOUBLE) } velocity;
typedef struct { COURSE(DOUBLE) } course;
typedef struct {
    struct { CAR(IN_BLOCK) } car;
    struct { ROAD(IN_BLOCK) } road;
    struct { PUSH(IN_BLOCK) } push;
    struct { INPUTS(IN_BLOCK) } command, now;
    struct { MOTION(IN_BLOCK) } motion;
    struct { FIXED(IN_BLOCK) } fixed;
    struct { LOAD(IN_BLOCK) } load;
} block;

static const double GRAVITY = 9.81, SLOW = 0.5;

INLINE double least(double a, double b) { return a < b ? a : b; }
INLINE double most(double a, double b) { return a > b ? a : b; }
INLINE double size(double a) { return a > 0.0 ? a : 0.0 - a; }
INLINE double within(double a, double low, double high) { return least(most(a, low), high); }

INLINE void sincos_of(double x, double *sine, double *cosine)
{
    double k = floor(x * 0.6366197723675814 + 0.5);
    double r = (x - k * 1.5707963267341256) - k * 6.077100506506192e-11;
    double z = r * r, p, s, c, q;
    p = 1.58969099521155010221e-10;
    p = p * z - 2.50507602534068634195e-08;
    p = p * z + 2.75573137070700676789e-06;
    p = p * z - 1.98412698298579493134e-04;
    p = p * z + 8.33333333332248946124e-03;
    p = p * z - 1.66666666666666324348e-01;
    s = r + r * (z * p);
    p = -1.13596475577881948265e-11;
    p = p * z + 2.08757232129817482790e-09;
    p = p * z - 2.75573143513906633035e-07;
    p = p * z + 2.48015872894767294178e-05;
    p = p * z - 1.38888888888741095749e-03;
    p = p * z + 4.16666666666666019037e-02;
    c = 1.0 - 0.5 * z + z * (z * p);
    q = k - 4.0 * floor(0.25 * k);
    double odd_s = (q == 1.0) | (q == 3.0) ? c : s, odd_c = (q == 1.0) | (q == 3.0) ? s : c;
    *sine = (q > 1.5 ? -1.0 : 1.0) * odd_s;
    *cosine = ((q == 1.0) | (q == 2.0) ? -1.0 : 1.0) * odd_c;
}

INLINE fixed fixed_of(car c, road r)
{
    fixed f;
    double weight = c.m * GRAVITY / (2.0 * (c.l_f + c.l_r)), half_weight = 0.5 * c.m * GRAVITY;
    f.per_m = 1.0 / c.m;
    f.per_I = 1.0 / c.I;
    f.front = 0.5 * (c.mu + c.mu_r) * weight * c.l_r;
    f.rear_l = c.mu * weight * c.l_f;
    f.rear_r = c.mu_r * weight * c.l_f;
    f.slope_f = c.C_f / (3.0 * f.front);
    f.per_front = 1.0 / (half_weight * c.d_f);
    f.per_rear = 1.0 / (half_weight * c.d_r);
    f.direct = c.m * c.h - c.S;
    f.per_lean = 1.0 / (c.I_x - c.S * c.S * f.per_m);
    f.per_r = 1.0 / c.r;
    f.per_ramp = 1.0 / r.ramp;
    f.half_track = 0.5 * c.d_r;
    return f;
}

INLINE load load_of(inputs now, double per_r)
{
    load l;
    sincos_of(now.delta, &l.sin_d, &l.cos_d);
    l.F_l = now.T_l * per_r;
    l.F_r = now.T_r * per_r;
    return l;
}

INLINE double squared_capacity(double limit, double drive)
{
    return most(limit * limit - drive * drive, 0.0025 * limit * limit);
}

INLINE double lateral(double tangent, double limit, double slope)
{
    double z = within(slope * tangent, -1.0, 1.0);
    return limit * z * (3.0 - 3.0 * size(z) + z * z);
}

/* Rates of the velocities and the roll; gravity is that of the step's middle. */
INLINE velocity rates(velocity at, load l, push p, car c, fixed f, double g_x, double g_y)
{
    velocity rate;
    double front = at.v_y + c.l_f * at.gamma, rear = at.v_y - c.l_r * at.gamma;
    double along_f = most(size(at.v_x * l.cos_d + front * l.sin_d), SLOW);
    double across_f = at.v_x * l.sin_d - front * l.cos_d, across_r = 0.0 - rear;
    double along_r = most(size(at.v_x), SLOW);

    double direct = f.direct * (at.v_x * at.gamma + g_y);
    double moment = c.K_x * at.phi + c.C_x * at.phi_dot + direct;
    double e_f = within(moment * f.per_front, -0.9, 0.9);
    double e_r = within(moment * f.per_rear, -0.9, 0.9);
    double narrow = 1.0 - e_f, wide = 1.0 + e_f;
    double rear_l = f.rear_l * (1.0 - e_r), rear_r = f.rear_r * (1.0 + e_r);
    double F_l = within(l.F_l, 0.0 - rear_l, rear_l), F_r = within(l.F_r, 0.0 - rear_r, rear_r);
    double square_l = squared_capacity(rear_l, F_l), square_r = squared_capacity(rear_r, F_r);
    double left = sqrt(square_l), right = sqrt(square_r);
    double sides = narrow * wide, squares = square_l * square_r;
    double per = 1.0 / (along_f * along_r * (sides * squares));
    double slope_f = f.slope_f * (along_r * squares * per);
    double slope_r = c.C_r * (1.0 / 3.0) * (along_f * sides * per);
    double F_yf = lateral(across_f, f.front * narrow, slope_f * wide) +
                  lateral(across_f, f.front * wide, slope_f * narrow);
    double F_yr = lateral(across_r, left, slope_r * square_r * left) +
                  lateral(across_r, right, slope_r * square_l * right);

    double F_yc = F_yf * l.cos_d, F_y = F_yc + F_yr + p.F_d, N_z = f.half_track * (F_r - F_l);
    double lever = c.S * (F_y * f.per_m + GRAVITY * at.phi);
    rate.phi = at.phi_dot;
    rate.phi_dot = (lever + (p.N_x - c.C_x * at.phi_dot - c.K_x * at.phi)) * f.per_lean;
    F_y = F_y + c.S * rate.phi_dot;
    rate.v_x = (F_l + F_r - F_yf * l.sin_d) * f.per_m + at.v_y * at.gamma - g_x;
    rate.v_y = F_y * f.per_m - at.v_x * at.gamma - g_y;
    rate.gamma = (c.l_f * F_yc - c.l_r * F_yr + N_z + p.N_d) * f.per_I;
    return rate;
}

INLINE double share_at(road r, fixed f, double s)
{
    return within((s - r.start) * f.per_ramp, 0.0, 1.0);
}

/* Rates of place and of the road's direction with these velocities. */
INLINE course course_at(motion at, double v_x, double v_y, road r, fixed f, int curved)
{
    course rate;
    double kappa = r.curvature * share_at(r, f, at.s), s_t, c_t, s_r, c_r;
    sincos_of(at.theta, &s_t, &c_t);
    sincos_of(at.psi - at.theta, &s_r, &c_r);
    double along = v_x * c_r - v_y * s_r;
    rate.y = v_x * s_r + v_y * c_r;
    rate.s = curved ? along / most(1.0 - kappa * at.y, 0.1) : along;
    rate.X = along * c_t - rate.y * s_t;
    rate.Y = along * s_t + rate.y * c_t;
    rate.theta = rate.s * kappa;
    return rate;
}

INLINE velocity after(velocity now, double h, velocity rate)
{
#define AFTER(k) now.k = now.k + h * rate.k;
    VELOCITY(AFTER)
    return now;
}

INLINE velocity means(velocity first, velocity middle, velocity last)
{
#define MEAN(k) first.k = (first.k + 4.0 * middle.k + last.k) * (1.0 / 6.0);
    VELOCITY(MEAN)
    return first;
}

INLINE motion kutta3(motion m, load first, load middle, load last, push p, car c, road r, fixed f,
                     double h, int curved, int sloped)
{
    double g_x = 0.0, g_y = 0.0;
    if (sloped) {
        double ahead = m.s + 0.5 * h * m.v_x, share = share_at(r, f, ahead), s_r, c_r;
        double turning = m.gamma - m.v_x * (r.curvature * share);
        double along = r.along * share, across = r.across * share;
        sincos_of(m.psi - m.theta + 0.5 * h * turning, &s_r, &c_r);
        g_x = along * c_r + across * s_r;
        g_y = across * c_r - along * s_r;
    }
    velocity start = {m.v_x, m.v_y, m.gamma, m.phi, m.phi_dot};
    velocity k_1 = rates(start, first, p, c, f, g_x, g_y), at_middle = after(start, 0.5 * h, k_1);
    velocity k_2 = rates(at_middle, middle, p, c, f, g_x, g_y);
    velocity at_end = after(after(start, 0.0 - h, k_1), 2.0 * h, k_2);
    velocity k_3 = rates(at_end, last, p, c, f, g_x, g_y), mean = means(start, at_middle, at_end);
    velocity now = after(start, h, means(k_1, k_2, k_3));

    double half = 0.5 * h, turn = h * mean.gamma, aside = turn * (1.0 / 12.0);
    double shorter = 1.0 - turn * turn * (1.0 / 24.0);
    double v_x = shorter * mean.v_x - aside * (now.v_y - m.v_y);
    double v_y = shorter * mean.v_y + aside * (now.v_x - m.v_x);
    motion between = m;
    between.psi = m.psi + h * (m.gamma + 2.0 * at_middle.gamma) * (1.0 / 6.0);
    if (curved) {
        course begun = course_at(m, m.v_x, m.v_y, r, f, curved);
        between.s = m.s + half * begun.s;
        between.y = m.y + half * begun.y;
        between.theta = m.theta + half * begun.theta;
    }
    course went = course_at(between, v_x, v_y, r, f, curved);
#define NOW(k) m.k = now.k;
#define WENT(k) m.k = m.k + h * went.k;
    VELOCITY(NOW) COURSE(WENT)
    m.psi = m.psi + turn;
    return m;
}

INLINE inputs lagged(inputs command, inputs now, double steer_left, double motor_left)
{
    now.delta = command.delta + (now.delta - command.delta) * steer_left;
    now.T_l = command.T_l + (now.T_l - command.T_l) * motor_left;
    now.T_r = command.T_r + (now.T_r - command.T_r) * motor_left;
    return now;
}

/* One tick of all cars of a block. */
INLINE void tick(block *b, double h, const double *left, int curved, int sloped)
{
#pragma omp simd
    for (int i = 0; i < BLOCK; i++) {
        car c; road r; push p; fixed f;
        inputs command, now;
        motion m;
        load first;
#define CAR_IN(k) c.k = b->car.k[i];
#define ROAD_IN(k) r.k = b->road.k[i];
#define PUSH_IN(k) p.k = b->push.k[i];
#define COMMAND_IN(k) command.k = b->command.k[i];
#define NOW_IN(k) now.k = b->now.k[i];
#define MOTION_IN(k) m.k = b->motion.k[i];
#define FIXED_IN(k) f.k = b->fixed.k[i];
#define LOAD_IN(k) first.k = b->load.k[i];
        CAR(CAR_IN) ROAD(ROAD_IN) PUSH(PUSH_IN) INPUTS(COMMAND_IN) INPUTS(NOW_IN)
        MOTION(MOTION_IN) FIXED(FIXED_IN) LOAD(LOAD_IN)
        load middle = load_of(lagged(command, now, left[0], left[2]), f.per_r);
        now = lagged(command, now, left[1], left[3]);
        load last = load_of(now, f.per_r);
        m = kutta3(m, first, middle, last, p, c, r, f, h, curved, sloped);
#define NOW_OUT(k) b->now.k[i] = now.k;
#define MOTION_OUT(k) b->motion.k[i] = m.k;
#define LOAD_OUT(k) b->load.k[i] = last.k;
        INPUTS(NOW_OUT) MOTION(MOTION_OUT) LOAD(LOAD_OUT)
    }
}

#define ALONE static __attribute__((noinline))
ALONE void tick_anywhere(block *b, double h, const double *left) { tick(b, h, left, 1, 1); }
ALONE void tick_straight(block *b, double h, const double *left) { tick(b, h, left, 0, 0); }

/* The numbers that are not in the arrays: constants and the first load. */
static void prepare(block *b)
{
    for (int i = 0; i < BLOCK; i++) {
        car c; road r;
        inputs now;
        CAR(CAR_IN) ROAD(ROAD_IN) INPUTS(NOW_IN)
        fixed f = fixed_of(c, r);
        load first = load_of(now, f.per_r);
#define FIXED_OUT(k) b->fixed.k[i] = f.k;
#define FIRST_OUT(k) b->load.k[i] = first.k;
        FIXED(FIXED_OUT) LOAD(FIRST_OUT)
    }
}

/* Ticks of h seconds of blocks of cars. Arrays (blocks, fields, BLOCK). left: the share left of a
 * deviation from the command: of steering at the middle and the end of a tick, then of motors. */
void plant(long blocks, long ticks, double h, const double *left, const double *cars,
           const double *roads, const double *pushes, const double *commands, double *motions,
           double *acting)
{
#define AT(part, array) ((array) + at * (long)(sizeof b.part / sizeof(double)))
    block b;
    for (long at = 0; at < blocks; at++) {
        memcpy(&b.car, AT(car, cars), sizeof b.car);
        memcpy(&b.road, AT(road, roads), sizeof b.road);
        memcpy(&b.push, AT(push, pushes), sizeof b.push);
        memcpy(&b.command, AT(command, commands), sizeof b.command);
        memcpy(&b.now, AT(now, acting), sizeof b.now);
        memcpy(&b.motion, AT(motion, motions), sizeof b.motion);
        prepare(&b);
        int curved = 0, sloped = 0;
        for (int i = 0; i < BLOCK; i++) {
            curved |= b.road.curvature[i] != 0.0;
            sloped |= b.road.across[i] != 0.0 || b.road.along[i] != 0.0;
        }
        if (curved || sloped)
            for (long j = 0; j < ticks; j++) tick_anywhere(&b, h, left);
        else
            for (long j = 0; j < ticks; j++) tick_straight(&b, h, left);
        memcpy(AT(now, acting), &b.now, sizeof b.now);
        memcpy(AT(motion, motions), &b.motion, sizeof b.motion);
    }
}
