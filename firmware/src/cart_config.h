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

#ifndef CART_BRAKING_UM_S2
#define CART_BRAKING_UM_S2 2500000LL /* um/s2: full motor inward slows any healthy cart at least so hard */
#endif
#ifndef CART_POLE_LEVER_UM
#define CART_POLE_LEVER_UM 27000 /* um, m_p l / (m_c + m_p): Quanser's medium pole; 79000 for the large one */
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
#define CART_SOFT_LIMIT_UM 27000 /* inside a stop */
#define CART_HARD_LIMIT_UM 8000  /* inside a stop */

/* The nearest whole count to a positive distance in um. */
#define CART_COUNTS(um) ((int32_t)(((int64_t)(um)*1000 + CART_NANOMETRES / 2) / CART_NANOMETRES))

#endif
