#include "cart_servo.h"

#include <math.h>

#define HEAVIER (CART_MOVING_MASS / 0.85) /* than the cart and pole for which the next three were chosen */
#define NEGLIGIBLE (0.02 * HEAVIER)       /* N, below which the motor stays off */
#define PROPORTIONAL (12.0 * HEAVIER)     /* N s/m */
#define INTEGRAL (80.0 * HEAVIER)         /* N/m */
#define TUNED_FOR 0.02                    /* s, the period for these gains; a longer one needs smaller gains */
#define GENTLE 0.2                        /* m/s^2, an acceleration that leaves the pole nearly still */

#define ROOM (CART_SPAN_UM < 800000 ? CART_SPAN_UM / 800000.0 : 1.0) /* the cart follows less on a short track */
#define FOLLOW (0.9 * ROOM)  /* m/s^2 of the cart for 1 rad/s of the pole */
#define RETURN 3.0           /* 1/s^2 */
#define DAMPING 2.0          /* 1/s */
#define HARDEST (2.5 * ROOM) /* m/s^2 */
#define STANDS 0.002 /* m/s, a speed up to which the cart counts as standing */

double cart_limit(double number, double largest)
{
    if (number > largest)
        return largest;
    return number < -largest ? -largest : number;
}

/* The motor value for a force in N, roughly: a line with an offset. */
static int16_t rough_motor(double force)
{
    double size = fabs(force);
    if (size < NEGLIGIBLE)
        return 0;
    if (size > CART_GENTLE_FORCE)
        size = CART_GENTLE_FORCE;
    double motor = copysign(CART_MOTOR_OFFSET + CART_MOTOR_PER_NEWTON * size, force);
    return (int16_t)cart_limit(motor, CART_LARGEST_MOTOR);
}

void cart_servo_reset(cart_servo *servo)
{
    servo->reference = servo->integral = 0.0;
}

int16_t cart_servo_motor(cart_servo *servo, double target, double speed, double seconds)
{
    servo->reference += cart_limit(target - servo->reference, GENTLE * seconds);
    double error = servo->reference - speed;
    double share = TUNED_FOR / seconds < 1.0 ? TUNED_FOR / seconds : 1.0;
    servo->integral = cart_limit(servo->integral + share * INTEGRAL * error * seconds, CART_GENTLE_FORCE);
    double ahead = servo->reference != 0.0 ? copysign(CART_MOVING_FRICTION, servo->reference) : 0.0;
    return rough_motor(ahead + share * PROPORTIONAL * error + servo->integral);
}

int16_t cart_brake_motor(double x, double x_dot, double swing, double swing_dot)
{
    double acceleration = -FOLLOW * swing_dot * cos(swing) - RETURN * x - DAMPING * x_dot;
    acceleration = cart_limit(acceleration, HARDEST);
    double moving = fabs(x_dot) > STANDS ? x_dot : acceleration;
    return rough_motor(CART_MOVING_MASS * acceleration + copysign(CART_MOVING_FRICTION, moving));
}
