#include "cart_homing.h"

#include "cart_numbers.h"

#define AT_LEAST_ONE(counts) ((counts) > 0 ? (counts) : 1)
#define QUARTER_TURN (CART_POLE_COUNTS / 4)
#define PI 3.14159265358979323846
#define POLE_RADIANS (2 * PI / CART_POLE_COUNTS) /* a count */
#define SPAN_NM ((int64_t)CART_SPAN_UM * 1000)
#define SPAN_TOLERANCE_NM (SPAN_NM * 3 / 100)

#define SEARCH_SPEED 0.08 /* m/s, towards a stop */
#define TRAVEL_SPEED 0.2  /* m/s, far from a stop whose position is known */
/* Distance from such a stop at which the slow search begins. A switch must not be overrun: the cart is slow before. */
#define TOUCH_ZONE_NM (CART_SWITCHES ? 120000000 : 60000000)
#define ASTRAY_NM 20000000 /* a motion the wrong way that means a reversed motor or encoder */
#define FAST_POLE (CART_POLE_COUNTS * 6LL / 10) /* counts/s; it may move the cart against its motor: 3.8 rad/s */
#define RELEASED CART_COUNTS(30000) /* so far inside the place where it is pressed, any switch is released: 30 mm */
#define FIRST_SWITCH (CART_SWITCHES & CART_LEFT ? CART_LEFT : CART_SWITCHES)
#define EXPECTS_RIGHT(homing) \
    (!CART_SWITCHES || ((homing)->stage == CART_TOUCH_RIGHT && CART_SWITCHES != CART_RIGHT))
#define AGAINST_STOP_US 400000u /* under full push without motion that mean a stop */
#define STANDS_COUNTS AT_LEAST_ONE(300000 / CART_NANOMETRES) /* largest motion in that time: 0.3 mm */
#define RUNS 0.1 /* m/s, from which a cart takes time to stop, unless something stops it at once */
#define HARDEST_STOP 5.0 /* m/s^2, of friction, the pole and the motor */
#define LONGEST_SEARCH_US (CART_SPAN_UM > 1500000 ? CART_SPAN_UM * 20u : 30000000u) /* for one stop */
#define LONGEST_LEAVING_US 5000000u /* to move off a switch, for which a second is usual */
#define CENTRED_NM 1000000
#define CROSSES 0.1 /* m/s, up to which a cart that crosses the middle between two readings is centred */
#define LONGEST_CENTRING_US (CART_SPAN_UM > 4000000 ? CART_SPAN_UM * 5u : 20000000u)

#define WHOLE_SWING_US 2000000u /* one period of a rod of 1.5 m */
#define SWING(centidegrees) AT_LEAST_ONE(((int64_t)(centidegrees)*CART_POLE_COUNTS + 18000) / 36000) /* counts */
#define STILL SWING(70)   /* peak to peak */
#define BRAKED SWING(260) /* peak to peak; the brake cannot improve a smaller swing */
#define LONGEST_BRAKING_US 20000000u
#define PATIENCE_US 20000000u /* after which NEARLY_STILL suffices, for a pole with hardly any friction */
#define NEARLY_STILL SWING(350) /* peak to peak */
#define LONGEST_WAIT_US 60000000u

typedef enum { YIELDS, ENDS, FAILS } outcome; /* a stage waits for the next reading, is done, or failed */

int32_t cart_zeros_middle(const cart_zeros *zeros)
{
    return cart_middle(zeros->left_stop, zeros->right_stop);
}

int32_t cart_zeros_half_span(const cart_zeros *zeros)
{
    return (int32_t)cart_floor_divide((int64_t)zeros->right_stop - zeros->left_stop, 2);
}

static double seconds(const cart_reading *reading)
{
    return reading->period_us / 1e6;
}

static double metres(int32_t from, int32_t to)
{
    return (double)((int64_t)to - from) * CART_METRES;
}

static void enter(cart_homing *homing, cart_homing_stage stage)
{
    homing->stage = stage;
    homing->entered = false;
}

void cart_homing_begin(cart_homing *homing)
{
    enter(homing, CART_SWITCHES ? CART_LEAVE_SWITCH : CART_TOUCH_LEFT);
    homing->waited_us = 0;
}

/* Count the time of a stage; return true for its first reading. */
static bool first_reading(cart_homing *homing, const cart_reading *reading, uint32_t window_us)
{
    if (homing->entered) {
        homing->elapsed_us += reading->period_us;
        return false;
    }
    homing->entered = true;
    homing->start = reading->cart;
    homing->elapsed_us = 0;
    homing->before = *reading;
    homing->ran = 0;
    homing->stopped = false;
    cart_servo_reset(&homing->servo);
    cart_window_reset(&homing->window, window_us);
    return true;
}

static double cart_speed(const cart_homing *homing, const cart_reading *reading)
{
    return metres(homing->before.cart, reading->cart) / seconds(reading);
}

/* In counts/s, since the reading before. */
static int64_t pole_speed(const cart_homing *homing, const cart_reading *reading)
{
    return cart_distance(reading->pole, homing->before.pole) * 1000000 / (int64_t)reading->period_us;
}

/* True if the cart moves the wrong way, faster than at the start of the stage, when it may have rolled, and
   faster than when a fast pole last pushed it. */
static bool goes_astray(cart_homing *homing, const cart_reading *reading, int direction, double speed)
{
    double wrong = -direction * speed;
    if (homing->elapsed_us <= reading->period_us || pole_speed(homing, reading) > FAST_POLE) {
        homing->start = reading->cart; /* two readings give the first speed */
        homing->rolled = wrong;
    }
    int64_t moved = ((int64_t)homing->start - reading->cart) * direction;
    return moved * CART_NANOMETRES > ASTRAY_NM && wrong > homing->rolled;
}

/* True if a switch is pressed where it cannot be: both at once, or far inside the end that it marks. */
static bool switches_lie(cart_homing *homing, int32_t cart)
{
    bool far_left = (int64_t)cart - homing->zeros.left_stop > RELEASED;
    bool far_right = (int64_t)homing->zeros.right_stop - cart > RELEASED;
    unsigned inside = (far_left ? CART_LEFT : 0u) | (far_right ? CART_RIGHT : 0u);
    homing->suspects = (uint8_t)(homing->pressed & (homing->pressed == CART_BOTH ? CART_BOTH : inside));
    return homing->suspects != 0;
}

/* True if a switch is pressed in the middle of the track. */
static bool switches_lie_inside(cart_homing *homing)
{
    homing->suspects = homing->pressed;
    return homing->pressed != 0;
}

/* A switch should have ended the motion; without one, a stop has to. */
static outcome misses(cart_homing *homing, uint8_t side)
{
    if (CART_SWITCHES)
        homing->suspects = side;
    return FAILS;
}

/* True if the cart stands under a full push in `direction` or, where it `travels`, stopped at once and stands at the
   next reading, too: a stop or something else holds it, or its encoder is dead. A fast pole can stop a cart. */
static bool is_held(cart_homing *homing, const cart_reading *reading, int direction, bool travels, double speed,
                    int16_t motor)
{
    double ran = direction * homing->ran, time = seconds(reading);
    bool fast = pole_speed(homing, reading) > FAST_POLE;
    double way = (ran - HARDEST_STOP / 2 * time) * time;
    bool runs_on = travels && !fast && ran >= RUNS && way > (2 * STANDS_COUNTS + 1) * CART_METRES;
    bool again = homing->stopped;
    homing->stopped = runs_on && cart_distance(reading->cart, homing->before.cart) <= STANDS_COUNTS;
    if (!homing->stopped)
        homing->ran = fast ? 0 : speed;
    homing->before = *reading;
    cart_window_add(&homing->window, reading->cart, reading->period_us);
    bool pushed = motor == direction * CART_FULL_PUSH && cart_window_spread(&homing->window) <= STANDS_COUNTS;
    return (homing->stopped && again) || pushed;
}

/* Move until a stop holds the cart or, with switches, until that of `side` is `pressed` or released. The right end is
   expected one span from the left one. */
static outcome touch_stop(cart_homing *homing, const cart_reading *reading, int direction, uint8_t side,
                          bool pressed, int16_t *motor)
{
    first_reading(homing, reading, AGAINST_STOP_US);
    if (homing->elapsed_us >= (pressed ? LONGEST_SEARCH_US : LONGEST_LEAVING_US))
        return misses(homing, side);
    if (CART_SWITCHES && switches_lie(homing, reading->cart))
        return FAILS;
    if (CART_SWITCHES && ((homing->pressed & side) != 0) == pressed)
        return ENDS;
    int64_t expected = (int64_t)homing->zeros.left_stop + CART_COUNTS(CART_SPAN_UM);
    int64_t away = expected - reading->cart;
    bool far = direction > 0 && EXPECTS_RIGHT(homing) && away * CART_NANOMETRES > TOUCH_ZONE_NM;
    double speed = cart_speed(homing, reading);
    if (goes_astray(homing, reading, direction, speed))
        return FAILS;
    *motor = cart_servo_motor(&homing->servo, direction * (far ? TRAVEL_SPEED : SEARCH_SPEED), speed,
                              seconds(reading));
    if (!is_held(homing, reading, direction, far, speed, *motor))
        return YIELDS;
    return CART_SWITCHES ? misses(homing, side) : ENDS;
}

#if CART_SWITCHES
/* Move off the switch that is searched first, if the cart stands on it. */
static outcome leave_switch(cart_homing *homing, const cart_reading *reading, int16_t *motor)
{
    if (!homing->entered)
        homing->zeros.left_stop = homing->zeros.right_stop = reading->cart;
    return touch_stop(homing, reading, FIRST_SWITCH == CART_LEFT ? 1 : -1, FIRST_SWITCH, false, motor);
}
#endif

/* Find the end on a side, unless only the other one has a switch: then the span tells where it is. */
static outcome touch_end(cart_homing *homing, const cart_reading *reading, int direction, int32_t *end,
                         int16_t *motor)
{
    uint8_t side = direction < 0 ? CART_LEFT : CART_RIGHT;
    if (CART_SWITCHES && !(CART_SWITCHES & side))
        return ENDS;
    outcome how = touch_stop(homing, reading, direction, side, true, motor);
    if (!CART_SWITCHES)
        *end = reading->cart;
    else if (how == ENDS)
        *end = homing->pressed_at;
    return how;
}

static bool span_is_right(cart_zeros *zeros)
{
    if (CART_SWITCHES == CART_LEFT)
        zeros->right_stop = zeros->left_stop + CART_COUNTS(CART_SPAN_UM);
    if (CART_SWITCHES == CART_RIGHT)
        zeros->left_stop = zeros->right_stop - CART_COUNTS(CART_SPAN_UM);
    int64_t span_nm = ((int64_t)zeros->right_stop - zeros->left_stop) * CART_NANOMETRES;
    return span_nm >= SPAN_NM - SPAN_TOLERANCE_NM && span_nm <= SPAN_NM + SPAN_TOLERANCE_NM;
}

/* Move gently to the middle and switch the motor off. */
static outcome centre(cart_homing *homing, const cart_reading *reading, int16_t *motor)
{
    first_reading(homing, reading, AGAINST_STOP_US);
    if (homing->elapsed_us >= LONGEST_CENTRING_US || (CART_SWITCHES && switches_lie(homing, reading->cart)))
        return FAILS;
    int32_t middle = cart_zeros_middle(&homing->zeros);
    double speed = cart_speed(homing, reading);
    bool crosses = (middle < reading->cart) != (middle < homing->before.cart) && speed <= CROSSES && speed >= -CROSSES;
    if (crosses || cart_distance(middle, reading->cart) * CART_NANOMETRES < CENTRED_NM)
        return ENDS;
    if (pole_speed(homing, reading) > FAST_POLE)
        homing->start = reading->cart;
    int64_t added = cart_distance(middle, reading->cart) - cart_distance(middle, homing->start);
    if (added * CART_NANOMETRES > ASTRAY_NM)
        return FAILS;
    double target = cart_limit(metres(reading->cart, middle), TRAVEL_SPEED); /* slows down over a second */
    *motor = cart_servo_motor(&homing->servo, target, speed, seconds(reading));
    return is_held(homing, reading, middle < reading->cart ? -1 : 1, true, speed, *motor) ? FAILS : YIELDS;
}

/* Watch the pole for a whole swing with the motor off; it hangs where it is fastest. */
static outcome find_hanging(cart_homing *homing, const cart_reading *reading, int16_t *motor)
{
    if (first_reading(homing, reading, 0)) {
        homing->zeros.hanging = reading->pole;
        homing->fastest = 0;
    } else {
        int64_t speed = pole_speed(homing, reading);
        if (speed > homing->fastest) {
            homing->zeros.hanging = cart_middle(reading->pole, homing->before.pole);
            homing->fastest = speed;
        }
    }
    homing->before = *reading;
    *motor = 0;
    if (CART_SWITCHES && switches_lie_inside(homing))
        return FAILS;
    return homing->elapsed_us >= WHOLE_SWING_US ? ENDS : YIELDS;
}

/* Brake the pole's swing by moving the cart about the middle. */
static outcome brake_swing(cart_homing *homing, const cart_reading *reading, int16_t *motor)
{
    if (first_reading(homing, reading, WHOLE_SWING_US))
        homing->widest = 0;
    if (homing->elapsed_us >= LONGEST_BRAKING_US)
        return ENDS;
    if (CART_SWITCHES && switches_lie_inside(homing))
        return FAILS;
    cart_window_add(&homing->window, reading->pole, reading->period_us);
    int64_t spread = cart_window_spread(&homing->window);
    if (spread <= BRAKED)
        return ENDS;
    if (homing->window.full && homing->elapsed_us < 2 * WHOLE_SWING_US && spread > homing->widest)
        homing->widest = spread;
    if (homing->window.full && spread > homing->widest + QUARTER_TURN)
        return FAILS; /* it pumps the swing: the pole's encoder is reversed */
    if (spread < QUARTER_TURN) /* the middle of such a small swing is the hanging pole */
        homing->zeros.hanging = cart_window_centre(&homing->window);
    int64_t swing = (int64_t)reading->pole - homing->zeros.hanging;
    int64_t turned = (int64_t)reading->pole - homing->before.pole;
    *motor = cart_brake_motor(metres(cart_zeros_middle(&homing->zeros), reading->cart),
                              cart_speed(homing, reading), (double)swing * POLE_RADIANS,
                              (double)turned * POLE_RADIANS / seconds(reading));
    homing->before = *reading;
    return YIELDS;
}

/* Wait with the motor off until the pole's swing is small; it hangs in the middle of the swing. */
static outcome wait_until_still(cart_homing *homing, const cart_reading *reading, int16_t *motor)
{
    first_reading(homing, reading, WHOLE_SWING_US);
    if (homing->elapsed_us >= LONGEST_WAIT_US || (CART_SWITCHES && switches_lie_inside(homing)))
        return FAILS;
    cart_window_add(&homing->window, reading->pole, reading->period_us);
    int64_t enough = homing->elapsed_us < PATIENCE_US ? STILL : NEARLY_STILL;
    *motor = 0;
    if (cart_window_spread(&homing->window) > enough)
        return YIELDS;
    homing->zeros.hanging = cart_window_centre(&homing->window);
    return ENDS;
}

static outcome handle(cart_homing *homing, const cart_reading *reading, int16_t *motor)
{
    outcome how;
    switch (homing->stage) {
#if CART_SWITCHES
    case CART_LEAVE_SWITCH:
        return leave_switch(homing, reading, motor);
#endif
    case CART_TOUCH_LEFT:
        return touch_end(homing, reading, -1, &homing->zeros.left_stop, motor);
    case CART_TOUCH_RIGHT:
        how = touch_end(homing, reading, 1, &homing->zeros.right_stop, motor);
        return how == ENDS && !span_is_right(&homing->zeros) ? FAILS : how;
    case CART_FIND_HANGING:
        return find_hanging(homing, reading, motor);
    case CART_BRAKE:
        return brake_swing(homing, reading, motor);
    case CART_WAIT_UNTIL_STILL:
        return wait_until_still(homing, reading, motor);
    default: /* CART_CENTRE, CART_CENTRE_AGAIN */
        return centre(homing, reading, motor);
    }
}

cart_homing_status cart_homing_step(cart_homing *homing, const cart_reading *reading, int16_t *motor)
{
    while (homing->stage < CART_ALL_STAGES_DONE) {
        outcome how = handle(homing, reading, motor);
        if (how == YIELDS)
            return CART_HOMING_GOES_ON;
        if (how == FAILS)
            return CART_HOMING_FAILED;
        enter(homing, (cart_homing_stage)(homing->stage + 1));
    }
    return CART_HOMING_DONE;
}
