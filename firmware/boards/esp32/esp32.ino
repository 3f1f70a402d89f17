/* Not compiled with the ESP32's tool chain (only its syntax was checked), never run on a board.

   ESP32 with the Arduino core 3.x (ESP-IDF 5). Pulse counters read the encoders, LEDC drives an H-bridge with
   two PWM inputs, UART0 speaks to the host over the USB connector.

   | pin    | to                                                                     |
   |--------|------------------------------------------------------------------------|
   | GPIO32 | cart encoder A, 3.3 V                                                  |
   | GPIO33 | cart encoder B                                                         |
   | GPIO25 | pole encoder A, 3.3 V                                                  |
   | GPIO26 | pole encoder B                                                         |
   | GPIO18 | H-bridge input that drives the cart right; 10 kohm to ground           |
   | GPIO19 | H-bridge input that drives the cart left; 10 kohm to ground            |
   | GPIO27 | left end switch, if cart_rig.h has one, 3.3 V                           |
   | GPIO13 | right end switch                                                       |
   | GND    | ground of the encoders, the H-bridge and the switches                  |

   5 V encoders need level shifters. The two resistors keep the motor off while the board resets. If a count
   or the cart runs the wrong way, swap A and B of that encoder, or the two inputs of the H-bridge. A switch joins
   its pin to ground and opens when the cart presses it (contacts C and NC): a broken wire counts as pressed. */
#include <Arduino.h>
#include <cart_loop.h>
#ifdef CART_ONBOARD_POLICY
#include <onboard.h>
#endif
#include <driver/pulse_cnt.h>
#include <esp_rom_gpio.h>
#include <esp_task_wdt.h>
#include <soc/gpio_sig_map.h>
#include <soc/gpio_struct.h>

#if CART_SWITCHES
static const int LEFT_SWITCH = 27, RIGHT_SWITCH = 13; /* high while pressed */
#endif
static const int CART_A = 32, CART_B = 33, POLE_A = 25, POLE_B = 26, RIGHT = 18, LEFT = 19;
static const uint32_t BAUD = 921600, PWM_HZ = 20000, HANG_MS = 150; /* longer than a period */
static const int PWM_BITS = 8, COUNTER_LIMIT = 32000, GLITCH_NS = 200;

static pcnt_unit_handle_t cart_counter, pole_counter;
static cart_loop loop_state;

/* A channel counts the edges of one signal; the level of the other one gives the direction. */
static void add_channel(pcnt_unit_handle_t unit, int edge, int level, pcnt_channel_edge_action_t rising,
                        pcnt_channel_edge_action_t falling)
{
    pcnt_chan_config_t pins = {};
    pcnt_channel_handle_t channel;
    pins.edge_gpio_num = edge;
    pins.level_gpio_num = level;
    ESP_ERROR_CHECK(pcnt_new_channel(unit, &pins, &channel));
    ESP_ERROR_CHECK(pcnt_channel_set_edge_action(channel, rising, falling));
    ESP_ERROR_CHECK(pcnt_channel_set_level_action(channel, PCNT_CHANNEL_LEVEL_ACTION_KEEP,
                                                  PCNT_CHANNEL_LEVEL_ACTION_INVERSE));
}

/* A quadrature counter of 4 counts per line; watch points at its limits extend it to 32 bits. */
static pcnt_unit_handle_t start_counter(int a, int b)
{
    pcnt_unit_config_t limits = {};
    pcnt_glitch_filter_config_t filter = {};
    pcnt_unit_handle_t unit;
    limits.low_limit = -COUNTER_LIMIT;
    limits.high_limit = COUNTER_LIMIT;
    limits.flags.accum_count = 1;
    filter.max_glitch_ns = GLITCH_NS;
    pinMode(a, INPUT_PULLUP);
    pinMode(b, INPUT_PULLUP);
    ESP_ERROR_CHECK(pcnt_new_unit(&limits, &unit));
    ESP_ERROR_CHECK(pcnt_unit_set_glitch_filter(unit, &filter));
    add_channel(unit, a, b, PCNT_CHANNEL_EDGE_ACTION_DECREASE, PCNT_CHANNEL_EDGE_ACTION_INCREASE);
    add_channel(unit, b, a, PCNT_CHANNEL_EDGE_ACTION_INCREASE, PCNT_CHANNEL_EDGE_ACTION_DECREASE);
    ESP_ERROR_CHECK(pcnt_unit_add_watch_point(unit, -COUNTER_LIMIT));
    ESP_ERROR_CHECK(pcnt_unit_add_watch_point(unit, COUNTER_LIMIT));
    ESP_ERROR_CHECK(pcnt_unit_enable(unit));
    ESP_ERROR_CHECK(pcnt_unit_clear_count(unit));
    ESP_ERROR_CHECK(pcnt_unit_start(unit));
    return unit;
}

/* Take both H-bridge inputs from the PWM and hold them low. It is called in a panic: no code in flash. */
static void IRAM_ATTR cut_motor(void)
{
    static_assert(RIGHT < 32 && LEFT < 32, "the pins of the other register");
    GPIO.out_w1tc = (1u << RIGHT) | (1u << LEFT);
    esp_rom_gpio_connect_out_signal(RIGHT, SIG_GPIO_OUT_IDX, false, false);
    esp_rom_gpio_connect_out_signal(LEFT, SIG_GPIO_OUT_IDX, false, false);
}

/* ESP-IDF calls this when the task watchdog expires, before the panic that restarts the board. */
extern "C" void IRAM_ATTR esp_task_wdt_isr_user_handler(void)
{
    cut_motor();
}

/* The Arduino core calls this at the start of a panic, before the report that takes up to a second. It needs the
   core's own linker flag --wrap=esp_panic_handler, which PlatformIO leaves out, and no -flto. */
static void IRAM_ATTR panicked(arduino_panic_info_t *information, void *argument)
{
    (void)information;
    (void)argument;
    cut_motor();
}

/* If no period ends for HANG_MS, the board cuts the motor and restarts. The restart alone does not cut it: it
   resets neither LEDC nor the pins. In a panic with the flash switched off, `panicked` is not reached, and the last
   motor value stays until setup(). */
static void start_watchdog(void)
{
    set_arduino_panic_handler(panicked, NULL);
    esp_task_wdt_config_t hang = {};
    hang.timeout_ms = HANG_MS;
    hang.trigger_panic = true;
    if (esp_task_wdt_reconfigure(&hang) != ESP_OK)
        ESP_ERROR_CHECK(esp_task_wdt_init(&hang));
    ESP_ERROR_CHECK(esp_task_wdt_add(NULL));
}

uint32_t cart_hardware_clock_us(void)
{
    return (uint32_t)micros();
}

/* Just after the counter has started again at its limit, the interrupt that adds the limit may still be pending, and
   the count is off by COUNTER_LIMIT. No encoder turns that far in a period: such a count is read again. */
static int32_t count_of(pcnt_unit_handle_t unit, int32_t *last)
{
    int count = 0;
    ESP_ERROR_CHECK(pcnt_unit_get_count(unit, &count));
    if (abs(count - *last) > COUNTER_LIMIT / 2)
        ESP_ERROR_CHECK(pcnt_unit_get_count(unit, &count));
    *last = count;
    return count;
}

int32_t cart_hardware_cart_count(void)
{
    static int32_t last;
    return count_of(cart_counter, &last);
}

int32_t cart_hardware_pole_count(void)
{
    static int32_t last;
    return count_of(pole_counter, &last);
}

#if CART_SWITCHES
uint8_t cart_hardware_switches(void)
{
    return (digitalRead(LEFT_SWITCH) ? CART_LEFT : 0u) | (digitalRead(RIGHT_SWITCH) ? CART_RIGHT : 0u);
}
#endif

void cart_hardware_set_motor(int16_t value)
{
    int on = value > 0 ? RIGHT : LEFT, off = value > 0 ? LEFT : RIGHT;
    ledcWrite(off, 0); /* first, so that both are never on */
    ledcWrite(on, value > 0 ? value : -value);
}

int cart_hardware_read(void)
{
    return Serial.read();
}

void cart_hardware_write(const uint8_t *frame, size_t length)
{
    if ((size_t)Serial.availableForWrite() >= length)
        Serial.write(frame, length);
}

void setup(void)
{
    pinMode(RIGHT, OUTPUT);
    pinMode(LEFT, OUTPUT);
    cut_motor();
    ledcAttach(RIGHT, PWM_HZ, PWM_BITS);
    ledcAttach(LEFT, PWM_HZ, PWM_BITS);
    cart_hardware_set_motor(0);
    Serial.setRxBufferSize(512);
    Serial.setTxBufferSize(512);
    Serial.begin(BAUD);
#if CART_SWITCHES
    pinMode(LEFT_SWITCH, INPUT_PULLUP);
    pinMode(RIGHT_SWITCH, INPUT_PULLUP);
#endif
    cart_counter = start_counter(CART_A, CART_B);
    pole_counter = start_counter(POLE_A, POLE_B);
    start_watchdog();
    cart_loop_boot(&loop_state);
#ifdef CART_ONBOARD_POLICY
    onboard_attach(&loop_state.core);
#endif
}

void loop(void)
{
    if (cart_loop_poll(&loop_state))
        esp_task_wdt_reset();
}
