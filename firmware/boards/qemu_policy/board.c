/* Compiled with arm-none-eabi-gcc 12.2 and run in QEMU 7.2 (mps2-an386, Cortex-M4); not a board to wire.

   Chooses the action of an exported agent for each observation in memory. UART 0 sends the time in us that
   TIMED choices take (u32, little-endian), then one byte for each action; 255 is POLICY_NO_ACTION. */
#include "policy.h"

#include <stdint.h>

#define REGISTER(address) (*(volatile uint32_t *)(address))
#define UART0 0x40004000u
#define DATA 0x0u
#define STATE 0x4u
#define CONTROL 0x8u
#define DIVIDER 0x10u
#define SEND_FULL 1u
#define COUNTER REGISTER(0x40028018u) /* of the board, 25 MHz / (PRESCALE + 1) */
#define PRESCALE REGISTER(0x4002801Cu)
#define COUNT REGISTER(0x21000000u)   /* of observations, which QEMU loads */
#define OBSERVATIONS ((const float *)0x21000010u)
#define TIMED 1000u

static void put(uint8_t byte)
{
    while (REGISTER(UART0 + STATE) & SEND_FULL)
        continue;
    REGISTER(UART0 + DATA) = byte;
}

int main(void)
{
    PRESCALE = 24u; /* 1 MHz */
    REGISTER(UART0 + DIVIDER) = 25000000u / 921600u;
    REGISTER(UART0 + CONTROL) = 0x1u;
    const uint32_t before = COUNTER;
    for (uint32_t number = 0; number < TIMED; number++)
        (void)policy_action(OBSERVATIONS + POLICY_INPUTS * (number % COUNT));
    const uint32_t time_us = COUNTER - before;
    for (int at = 0; at < 4; at++)
        put((uint8_t)(time_us >> (8 * at)));
    for (uint32_t number = 0; number < COUNT; number++)
        put((uint8_t)policy_action(OBSERVATIONS + POLICY_INPUTS * number));
    for (;;)
        continue;
}
