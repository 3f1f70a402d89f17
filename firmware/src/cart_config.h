/* The numbers of one cart. A build for other hardware overrides them with -D or edits this file. No count is
   converted: the host needs the same numbers (docs/extending.md). */
#ifndef CART_CONFIG_H
#define CART_CONFIG_H

#ifndef CART_NANOMETRES
#define CART_NANOMETRES 22749 /* nm per count of the cart's encoder */
#endif
#ifndef CART_POLE_COUNTS
#define CART_POLE_COUNTS 4096 /* counts per turn of the pole's encoder */
#endif
#ifndef CART_SPAN_UM
#define CART_SPAN_UM 814000 /* um between the stops, nominal */
#endif
#ifndef CART_PENDING
#define CART_PENDING 1 /* motor values that can wait for their latency; a board applies them on arrival */
#endif

/* 1.1.0 knows START_POLICY, 1.0.0 does not; in 1.1.1 a policy starts anew after the watchdog stopped it. */
#define CART_FIRMWARE_MAJOR 1
#define CART_FIRMWARE_MINOR 1
#define CART_FIRMWARE_PATCH 1

#define CART_LARGEST_MOTOR 255
#define CART_PERIOD_US 20000u /* at boot */
#define CART_SHORTEST_US 5000u
#define CART_LONGEST_US 100000u
#define CART_WATCHDOG_PERIODS 3u
#define CART_SOFT_LIMIT_UM 27000 /* inside a stop */
#define CART_HARD_LIMIT_UM 8000  /* inside a stop */

/* The nearest whole count to a positive distance in um. */
#define CART_COUNTS(um) ((int32_t)(((int64_t)(um)*1000 + CART_NANOMETRES / 2) / CART_NANOMETRES))

#endif
