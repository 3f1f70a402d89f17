/* Encoders, track, motor and pole of cart=ip02. cartpole-export format=firmware writes this file;
   flags -D override single numbers. No count is converted: the host needs the same numbers. */
#ifndef CART_RIG_H
#define CART_RIG_H

#ifndef CART_NANOMETRES
#define CART_NANOMETRES 22749 /* nm per count of the cart's encoder */
#endif
#ifndef CART_POLE_COUNTS
#define CART_POLE_COUNTS 4096 /* counts per turn of the pole's encoder */
#endif
#ifndef CART_SPAN_UM
#define CART_SPAN_UM 814000 /* um between the stops, nominal */
#endif
#ifndef CART_SOFT_LIMIT_UM
#define CART_SOFT_LIMIT_UM 27000 /* um inside a stop: from there on outward motor values give 0 */
#endif
#ifndef CART_HARD_LIMIT_UM
#define CART_HARD_LIMIT_UM 8000 /* um inside a stop: an armed cart there is faulted */
#endif
#ifndef CART_BRAKING_UM_S2
#define CART_BRAKING_UM_S2 2500000 /* um/s^2: full motor inward slows any healthy cart at least so hard */
#endif
#ifndef CART_HARD_PUSH
#define CART_HARD_PUSH 200 /* smallest motor value that moves any healthy cart */
#endif
#ifndef CART_MOVING_MASS
#define CART_MOVING_MASS 0.85 /* kg: cart and pole, roughly, as all numbers below */
#endif
#ifndef CART_MOVING_FRICTION
#define CART_MOVING_FRICTION 0.5 /* N */
#endif
#ifndef CART_MOTOR_OFFSET
#define CART_MOTOR_OFFSET 50.0 /* motor value at which the force starts */
#endif
#ifndef CART_MOTOR_PER_NEWTON
#define CART_MOTOR_PER_NEWTON 50.0 /* motor values per N beyond it */
#endif
#ifndef CART_GENTLE_FORCE
#define CART_GENTLE_FORCE 3.0 /* N, the largest of homing */
#endif
#ifndef CART_SWITCHES
#define CART_SWITCHES 0 /* end switches: 0 none, 1 left, 2 right, 3 both */
#endif
#ifndef CART_POLE_LEVER_UM
#define CART_POLE_LEVER_UM 27206 /* um: m_p l / (m_c + m_p) of the pole, for the brake */
#endif

#endif
