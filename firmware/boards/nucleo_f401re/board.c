/* Compiled with arm-none-eabi-gcc 12.2, never run on a board; see docs/firmware.md.

   STMicroelectronics NUCLEO-F401RE (STM32F401RE, Cortex-M4 at 83 MHz), without vendor code. The ST-LINK's
   virtual serial port is the host's port. Timers 5 and 2 read the encoders with 32 bits, timer 3 drives an
   H-bridge with two PWM inputs, timer 4 is the clock.

   | pin  | connector  | to                                                                          |
   |------|------------|-----------------------------------------------------------------------------|
   | PA0  | A0         | cart encoder A (TIM5 channel 1), 3.3 V                                      |
   | PA1  | A1         | cart encoder B (TIM5 channel 2)                                             |
   | PA15 | CN7 pin 17 | pole encoder A (TIM2 channel 1), 3.3 V                                      |
   | PB3  | D3         | pole encoder B (TIM2 channel 2)                                             |
   | PA6  | D12        | H-bridge input that drives the cart right (TIM3 channel 1); 10 kohm to ground |
   | PA7  | D11        | H-bridge input that drives the cart left (TIM3 channel 2); 10 kohm to ground |
   | PA8  | D7         | left end switch, if cart_rig.h has one, 3.3 V                                |
   | PA9  | D8         | right end switch                                                            |
   | GND  | GND        | ground of the encoders, the H-bridge and the switches                       |

   5 V encoders need level shifters. The two resistors keep the motor off while the board resets. If a count
   or the cart runs the wrong way, swap A and B of that encoder, or the two inputs of the H-bridge. A switch joins
   its pin to ground and opens when the cart presses it (contacts C and NC): a broken wire counts as pressed. */
#include "cart_loop.h"
#ifdef CART_ONBOARD_POLICY
#include "onboard.h"
#endif

#include <stdint.h>

#define REGISTER(address) (*(volatile uint32_t *)(address))

#define RCC(offset) REGISTER(0x40023800u + (offset))
#define RCC_CR RCC(0x00u)
#define RCC_PLLCFGR RCC(0x04u)
#define RCC_CFGR RCC(0x08u)
#define RCC_AHB1ENR RCC(0x30u)
#define RCC_APB1ENR RCC(0x40u)
#define PWR_CR REGISTER(0x40007000u)
#define EXTI_IMR REGISTER(0x40013C00u)
#define EXTI_RTSR REGISTER(0x40013C08u)
#define SUPPLY_LINE 16u /* of EXTI: the supply detector */
#define SUPPLY_INTERRUPT 1u
#define FLASH_ACR REGISTER(0x40023C00u)

#define GPIOA(offset) REGISTER(0x40020000u + (offset))
#define GPIOB(offset) REGISTER(0x40020400u + (offset))
#define MODER 0x00u
#define PUPDR 0x0Cu
#define IDR 0x10u
#define AFRL 0x20u
#define AFRH 0x24u

#define TIM2 0x40000000u
#define TIM3 0x40000400u
#define TIM4 0x40000800u
#define TIM5 0x40000C00u
#define CR1 0x00u
#define SMCR 0x08u
#define EGR 0x14u
#define CCMR1 0x18u
#define CCER 0x20u
#define CNT 0x24u
#define PSC 0x28u
#define ARR 0x2Cu
#define CCR1 0x34u
#define CCR2 0x38u

#define USART2(offset) REGISTER(0x40004400u + (offset))
#define USART_SR USART2(0x00u)
#define USART_DR USART2(0x04u)
#define USART_BRR USART2(0x08u)
#define USART_CR1 USART2(0x0Cu)
#define RECEIVED (1u << 5)
#define OVERRUN (1u << 3)
#define CAN_SEND (1u << 7)
#define USART2_INTERRUPT 38u

#define IWDG(offset) REGISTER(0x40003000u + (offset))
#define NVIC_ISER0 REGISTER(0xE000E100u)
#define NVIC_ISER1 REGISTER(0xE000E104u)

#define CORE_MHZ 83u
#define APB1_HZ 41500000u
#define BAUD 921600u       /* APB1_HZ / 45 is 0.07 % more; the oscillator's own error adds to it */
#define SWITCHES_PIN 8u    /* of port A, the left one; high while pressed */
#define PWM_STEPS 255u     /* motor value 255 is always on */
#define PWM_PRESCALER 16u  /* 83 MHz / 16 / 255 = 20.3 kHz */
#define RECEIVE_BYTES 512u /* powers of two */
#define SEND_BYTES 512u

static volatile uint8_t received[RECEIVE_BYTES], to_send[SEND_BYTES];
static volatile uint32_t received_head, received_tail, send_head, send_tail;

/* 83 MHz from the internal oscillator: 16 MHz / 16 * 332 / 4; APB1 has half of it, its timers all of it. */
static void start_clock(void)
{
    FLASH_ACR = (1u << 9) | (1u << 8) | 2u; /* instruction cache, prefetch, two wait states */
    RCC_PLLCFGR = 16u | (332u << 6) | (1u << 16) | (7u << 24);
    RCC_CR |= 1u << 24;
    while (!(RCC_CR & (1u << 25)))
        continue;
    RCC_CFGR = (4u << 10) | 2u;
    while ((RCC_CFGR & (3u << 2)) != (2u << 2))
        continue;
    RCC_APB1ENR |= 1u << 2; /* TIM4 */
    (void)RCC_APB1ENR;
    REGISTER(TIM4 + PSC) = CORE_MHZ - 1u; /* 1 MHz */
    REGISTER(TIM4 + EGR) = 1u;
    REGISTER(TIM4 + CR1) = 1u;
}

/* A supply below about 2.9 V resets the board, which switches the motor off, before the processor fails. */
static void watch_supply(void)
{
    RCC_APB1ENR |= 1u << 28; /* PWR */
    (void)RCC_APB1ENR;
    PWR_CR |= (7u << 5) | (1u << 4);
    EXTI_RTSR |= 1u << SUPPLY_LINE;
    EXTI_IMR |= 1u << SUPPLY_LINE;
    NVIC_ISER0 = 1u << SUPPLY_INTERRUPT; /* unexpected() of startup.c */
}

/* Give a pin of port A or B to a peripheral. */
static void set_alternate(uint32_t port, uint32_t pin, uint32_t function)
{
    uint32_t high = pin >= 8u ? AFRH : AFRL, shift = 4u * (pin % 8u);
    REGISTER(port + high) = (REGISTER(port + high) & ~(15u << shift)) | (function << shift);
    REGISTER(port + MODER) = (REGISTER(port + MODER) & ~(3u << (2u * pin))) | (2u << (2u * pin));
}

static void pull_up(uint32_t port, uint32_t pin)
{
    REGISTER(port + PUPDR) = (REGISTER(port + PUPDR) & ~(3u << (2u * pin))) | (1u << (2u * pin));
}

static void start_pins(void)
{
    uint32_t a = 0x40020000u, b = 0x40020400u;
    RCC_AHB1ENR |= 3u;                                             /* ports A and B */
    RCC_APB1ENR |= (1u << 0) | (1u << 1) | (1u << 3) | (1u << 17); /* TIM2, TIM3, TIM5, USART2 */
    (void)RCC_APB1ENR;
    set_alternate(a, 0, 2);
    set_alternate(a, 1, 2);
    set_alternate(a, 15, 1);
    set_alternate(b, 3, 1);
    pull_up(a, 0);
    pull_up(a, 1);
    pull_up(a, 15);
    pull_up(b, 3);
#if CART_SWITCHES
    pull_up(a, SWITCHES_PIN);
    pull_up(a, SWITCHES_PIN + 1u);
#endif
    set_alternate(a, 2, 7);
    set_alternate(a, 3, 7);
}

/* A quadrature counter of 4 counts per line with a short input filter. */
static void start_counter(uint32_t timer)
{
    REGISTER(timer + CCMR1) = 0x3131u; /* both inputs direct, 8 samples */
    REGISTER(timer + SMCR) = 3u;       /* encoder mode 3 */
    REGISTER(timer + ARR) = 0xFFFFFFFFu;
    REGISTER(timer + CNT) = 0;
    REGISTER(timer + CR1) = 1u;
}

static void start_motor(void)
{
    REGISTER(TIM3 + PSC) = PWM_PRESCALER - 1u;
    REGISTER(TIM3 + ARR) = PWM_STEPS - 1u;
    REGISTER(TIM3 + CCR1) = 0;
    REGISTER(TIM3 + CCR2) = 0;
    REGISTER(TIM3 + CCMR1) = 0x6868u; /* PWM mode 1, preloaded */
    REGISTER(TIM3 + CCER) = 0x11u;
    REGISTER(TIM3 + EGR) = 1u;
    REGISTER(TIM3 + CR1) = 0x81u;
    set_alternate(0x40020000u, 6, 2);
    set_alternate(0x40020000u, 7, 2);
}

static void start_port(void)
{
    USART_BRR = (APB1_HZ + BAUD / 2u) / BAUD;
    USART_CR1 = (1u << 13) | RECEIVED | (1u << 3) | (1u << 2);
    NVIC_ISER1 = 1u << (USART2_INTERRUPT - 32u);
}

/* A board on which no period ends resets, which switches the motor off: after about 190 ms, or 130 to 350 ms
   with an oscillator of 47 to 17 kHz. The longest period is 100 ms. */
static void start_watchdog(void)
{
    IWDG(0x0u) = 0xCCCCu;
    IWDG(0x0u) = 0x5555u;
    IWDG(0x4u) = 0; /* 32 kHz / 4 */
    IWDG(0x8u) = 1500u;
    while (IWDG(0xCu))
        continue;
    IWDG(0x0u) = 0xAAAAu;
}

void usart2_interrupt(void)
{
    uint32_t status = USART_SR;
    if (status & (RECEIVED | OVERRUN)) {
        uint8_t byte = (uint8_t)USART_DR;
        if (received_head - received_tail < RECEIVE_BYTES)
            received[received_head++ % RECEIVE_BYTES] = byte;
    }
    if ((status & CAN_SEND) && (USART_CR1 & CAN_SEND)) {
        if (send_tail != send_head)
            USART_DR = to_send[send_tail++ % SEND_BYTES];
        else
            USART_CR1 &= ~CAN_SEND;
    }
}

uint32_t cart_hardware_clock_us(void)
{
    static uint16_t last;
    static uint32_t clock_us;
    uint16_t now = (uint16_t)REGISTER(TIM4 + CNT); /* wraps after 65 ms; the main loop is much faster */
    clock_us += (uint16_t)(now - last);
    last = now;
    return clock_us;
}

int32_t cart_hardware_cart_count(void)
{
    return (int32_t)REGISTER(TIM5 + CNT);
}

int32_t cart_hardware_pole_count(void)
{
    return (int32_t)REGISTER(TIM2 + CNT);
}

#if CART_SWITCHES
uint8_t cart_hardware_switches(void)
{
    return (uint8_t)(GPIOA(IDR) >> SWITCHES_PIN & CART_BOTH);
}
#endif

void cart_hardware_set_motor(int16_t value)
{
    REGISTER(TIM3 + CR1) |= 2u; /* both change at the end of the same PWM cycle: never on together */
    REGISTER(TIM3 + CCR1) = value > 0 ? (uint32_t)value : 0u;
    REGISTER(TIM3 + CCR2) = value < 0 ? (uint32_t)-value : 0u;
    REGISTER(TIM3 + CR1) &= ~2u;
}

int cart_hardware_read(void)
{
    if (received_tail == received_head)
        return -1;
    return received[received_tail++ % RECEIVE_BYTES];
}

void cart_hardware_write(const uint8_t *frame, size_t length)
{
    if (length > SEND_BYTES - (send_head - send_tail))
        return;
    for (size_t at = 0; at < length; at++)
        to_send[(send_head + at) % SEND_BYTES] = frame[at];
    send_head += (uint32_t)length;
    USART_CR1 |= CAN_SEND;
}

int main(void)
{
    static cart_loop loop;
    start_clock();
    watch_supply();
    start_pins();
    start_motor();
    start_counter(TIM5);
    start_counter(TIM2);
    start_port();
    cart_loop_boot(&loop);
#ifdef CART_ONBOARD_POLICY
    onboard_attach(&loop.core);
#endif
    start_watchdog();
    for (;;) {
        if (cart_loop_poll(&loop))
            IWDG(0x0u) = 0xAAAAu;
    }
}
