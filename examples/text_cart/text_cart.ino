/* A cart that speaks lines of text: `micros,cart,pole` each 10 ms, and takes a motor value from -255 to 255 a line.

       cartpole-preflight cart=mine.yaml plant=text plant.port=/dev/ttyUSB0 plant.full=255 plant.watchdog=true

   For any Arduino with four interrupt pins and 32-bit counters (ESP32, Teensy, Due, Nano Every); it was compiled
   and run with a stand-in for the Arduino core, not on a board. docs/my-cart.md says what this computer does.
   If a count or the cart runs the wrong way, swap A and B of that encoder, or RIGHT and LEFT. */
#include <Arduino.h>

const int CART_A = 32, CART_B = 33, POLE_A = 25, POLE_B = 26; /* encoders */
const int RIGHT = 18, LEFT = 19;                              /* PWM inputs of the H-bridge */
const unsigned long PERIOD_US = 10000, SILENCE_MS = 100;

volatile long cart_counts = 0, pole_counts = 0;

/* Each edge of A or B is a count. */
void cart_a() { cart_counts += digitalRead(CART_A) == digitalRead(CART_B) ? -1 : 1; }
void cart_b() { cart_counts += digitalRead(CART_A) == digitalRead(CART_B) ? 1 : -1; }
void pole_a() { pole_counts += digitalRead(POLE_A) == digitalRead(POLE_B) ? -1 : 1; }
void pole_b() { pole_counts += digitalRead(POLE_A) == digitalRead(POLE_B) ? 1 : -1; }

void drive(int motor) {
    analogWrite(motor > 0 ? LEFT : RIGHT, 0); /* first, so that both are never on */
    analogWrite(motor > 0 ? RIGHT : LEFT, abs(motor));
}

void setup() {
    const int inputs[] = {CART_A, CART_B, POLE_A, POLE_B};
    for (int pin : inputs) pinMode(pin, INPUT_PULLUP);
    pinMode(RIGHT, OUTPUT);
    pinMode(LEFT, OUTPUT);
    drive(0);
    attachInterrupt(digitalPinToInterrupt(CART_A), cart_a, CHANGE);
    attachInterrupt(digitalPinToInterrupt(CART_B), cart_b, CHANGE);
    attachInterrupt(digitalPinToInterrupt(POLE_A), pole_a, CHANGE);
    attachInterrupt(digitalPinToInterrupt(POLE_B), pole_b, CHANGE);
    Serial.begin(115200);
}

/* A line is a number from -255 to 255 and nothing else; any other line is ignored. */
bool motor_value(const char *text, unsigned length, int *motor) {
    char *end;
    long value = strtol(text, &end, 10);
    if (end == text) return false;
    while (*end == '\r' || *end == ' ') end++;
    if (end != text + length || value < -255 || value > 255) return false;
    *motor = (int)value;
    return true;
}

void loop() {
    static char text[16];
    static unsigned length = 0;
    static unsigned long measured_us = micros(), heard_ms = millis(), byte_ms = millis();
    for (int bytes = 0; bytes < 64 && Serial.available() > 0; bytes++) { /* no stream of bytes stops the watchdog */
        char letter = (char)Serial.read();
        byte_ms = millis();
        int motor;
        if (letter != '\n') {
            if (length < sizeof text) text[length++] = letter; /* a line that is too long is ignored */
            continue;
        }
        if (length < sizeof text) {
            text[length] = '\0';
            if (motor_value(text, length, &motor)) {
                drive(motor);
                heard_ms = millis();
            }
        }
        length = 0;
    }
    if (millis() - heard_ms > SILENCE_MS) drive(0); /* the watchdog */
    if (length > 0 && millis() - byte_ms > SILENCE_MS) length = sizeof text; /* half a line: the rest is ignored, too */
    if (micros() - measured_us >= PERIOD_US) {
        measured_us += PERIOD_US;
        if (micros() - measured_us >= PERIOD_US) measured_us = micros(); /* late lines are left out */
        noInterrupts();
        long cart = cart_counts, pole = pole_counts;
        interrupts();
        Serial.print(micros());
        Serial.print(',');
        Serial.print(cart);
        Serial.print(',');
        Serial.println(pole);
    }
}
