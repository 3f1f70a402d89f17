/* The numbers of the firmware. Those of the rig are in cart_rig.h. */
#ifndef CART_CONFIG_H
#define CART_CONFIG_H

#include "cart_rig.h"

#ifndef CART_POLE_LEVER_UM
#error "an earlier cart_rig.h: write it again, cartpole-export format=firmware cart=mine.yaml pole=my_pole.yaml"
#endif

#ifndef CART_PENDING
#define CART_PENDING 1 /* motor values that can wait for their latency; a board applies them on arrival */
#endif

/* From 2.0.0 on, protocol version 2. */
#define CART_FIRMWARE_MAJOR 2
#define CART_FIRMWARE_MINOR 0
#define CART_FIRMWARE_PATCH 0

#define CART_LARGEST_MOTOR 255
#define CART_PERIOD_US 20000u /* at boot */
#define CART_SHORTEST_US 5000u
#define CART_LONGEST_US 100000u
#define CART_WATCHDOG_PERIODS 3u /* after a state was measured, no value that answers it is in force any more */
#define CART_LEASE_US 500000u     /* without an accepted frame, after which homing ends */

/* Bits of end switches: in CART_SWITCHES, those that the rig has. */
#define CART_LEFT 1u
#define CART_RIGHT 2u
#define CART_BOTH 3u

/* The nearest whole count to a positive distance in um. */
#define CART_COUNTS(um) ((int32_t)(((int64_t)(um)*1000 + CART_NANOMETRES / 2) / CART_NANOMETRES))

#endif
