/* Compiled with arm-none-eabi-gcc 12.2 and run in QEMU 7.2 (mps2-an386, Cortex-M4); not a board to wire.

   UART 0 speaks to the host. UART 1 stands in for the encoders and the motor: it speaks to a program that has
   the physics. Little-endian, without a checksum:

     'M', clock us u32, motor value i16    the motor value in force from now on
     'X' or 'P', clock us u32              asks for the count of the cart or of the pole; the answer is an i32
     'S', clock us u32                     asks for the end switches that are pressed: an i32 */
#include "cart_loop.h"
#ifdef CART_ONBOARD_POLICY
#include "onboard.h"
#endif

#define REGISTER(address) (*(volatile uint32_t *)(address))
#define UART0 0x40004000u
#define UART1 0x40005000u
#define DATA 0x0u
#define STATE 0x4u
#define CONTROL 0x8u
#define CLEAR 0xCu
#define DIVIDER 0x10u
#define SEND_FULL 1u
#define RECEIVE_FULL 2u
#define RECEIVE_INTERRUPT 2u

#define COUNTER REGISTER(0x40028018u)   /* of the board, 25 MHz / (PRESCALE + 1) */
#define PRESCALE REGISTER(0x4002801Cu)
#define SYSTICK(offset) REGISTER(0xE000E010u + (offset))
#define NVIC_ISER0 REGISTER(0xE000E100u)

#define RECEIVE_BYTES 512u /* a power of two */

static volatile uint8_t received[RECEIVE_BYTES];
static volatile uint32_t received_head, received_tail;
static uint32_t clock_us; /* read last: the main loop counts a measurement as of this moment */

static void put(uint32_t uart, uint8_t byte)
{
    while (REGISTER(uart + STATE) & SEND_FULL)
        continue;
    REGISTER(uart + DATA) = byte;
}

static void put_number(uint32_t number, int bytes)
{
    for (int at = 0; at < bytes; at++)
        put(UART1, (uint8_t)(number >> (8 * at)));
}

static int32_t ask(uint8_t what)
{
    uint32_t count = 0;
    put(UART1, what);
    put_number(clock_us, 4);
    for (int at = 0; at < 4; at++) {
        while (!(REGISTER(UART1 + STATE) & RECEIVE_FULL))
            continue;
        count |= (REGISTER(UART1 + DATA) & 0xFFu) << (8 * at);
    }
    return (int32_t)count;
}

void uart0_interrupt(void)
{
    REGISTER(UART0 + CLEAR) = RECEIVE_INTERRUPT;
    while (REGISTER(UART0 + STATE) & RECEIVE_FULL) {
        uint8_t byte = (uint8_t)REGISTER(UART0 + DATA);
        if (received_head - received_tail < RECEIVE_BYTES)
            received[received_head++ % RECEIVE_BYTES] = byte;
    }
}

/* Wakes the main loop. */
void systick_interrupt(void)
{
}

uint32_t cart_hardware_clock_us(void)
{
    clock_us = COUNTER;
    return clock_us;
}

int32_t cart_hardware_cart_count(void)
{
    return ask('X');
}

int32_t cart_hardware_pole_count(void)
{
    return ask('P');
}

#if CART_SWITCHES
uint8_t cart_hardware_switches(void)
{
    return (uint8_t)ask('S');
}
#endif

void cart_hardware_set_motor(int16_t value)
{
    static int16_t in_force;
    if (value == in_force)
        return;
    in_force = value;
    put(UART1, 'M');
    put_number(cart_hardware_clock_us(), 4);
    put_number((uint16_t)value, 2);
}

int cart_hardware_read(void)
{
    if (received_tail == received_head)
        return -1;
    return received[received_tail++ % RECEIVE_BYTES];
}

void cart_hardware_write(const uint8_t *frame, size_t length)
{
    for (size_t at = 0; at < length; at++)
        put(UART0, frame[at]);
}

int main(void)
{
    static cart_loop loop;
    PRESCALE = 24u; /* 1 MHz */
    REGISTER(UART0 + DIVIDER) = 25000000u / 921600u;
    REGISTER(UART1 + DIVIDER) = 25000000u / 921600u;
    REGISTER(UART0 + CONTROL) = 0xBu; /* send, receive, interrupt for each byte */
    REGISTER(UART1 + CONTROL) = 0x3u;
    NVIC_ISER0 = 1u;
    SYSTICK(0x4u) = 25000u - 1u; /* 1 kHz */
    SYSTICK(0x8u) = 0;
    SYSTICK(0x0u) = 7u;
    cart_loop_boot(&loop);
#ifdef CART_ONBOARD_POLICY
    onboard_attach(&loop.core);
#endif
    for (;;) {
        cart_loop_poll(&loop);
        if (received_tail == received_head)
            __asm volatile("wfi");
    }
}
