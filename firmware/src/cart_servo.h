/* Slow motions: a speed servo and a brake for the swinging pole. The only floating-point code.

   Both use rough numbers of the cart: motor curve, mass and friction in cart_rig.h. SI units; positive to the
   right. Compile without contraction of products and sums (-ffp-contract=off), so that every machine computes
   the same motor values. */
#ifndef CART_SERVO_H
#define CART_SERVO_H

#include "cart_config.h"

#include <stdint.h>

/* The motor value of the largest force of these motions. */
#define CART_GENTLE_MOTOR (CART_MOTOR_OFFSET + CART_MOTOR_PER_NEWTON * CART_GENTLE_FORCE)
#define CART_FULL_PUSH ((int16_t)(CART_GENTLE_MOTOR < CART_LARGEST_MOTOR ? CART_GENTLE_MOTOR : CART_LARGEST_MOTOR))
#define CART_METRES (CART_NANOMETRES / 1e9) /* per count */

typedef struct {
    double reference; /* m/s, follows the target gently */
    double integral;  /* N */
} cart_servo;

void cart_servo_reset(cart_servo *servo);

/* The motor value for the next period; target and measured speed in m/s. */
int16_t cart_servo_motor(cart_servo *servo, double target, double speed, double seconds);

/* The motor value that brakes a swing; x in m from the middle, swing in rad from hanging, and their rates. */
int16_t cart_brake_motor(double x, double x_dot, double swing, double swing_dot);

/* A number limited to -largest to largest. */
double cart_limit(double number, double largest);

#endif
