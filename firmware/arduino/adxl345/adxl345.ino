// An ADXL345 by I2C on an Arduino Uno (SDA to A4, SCL to A5, SDO to ground). Sends 400 lines a second:
// a counter and three accelerations, 256 per g. The counter shows exactly which lines are lost.

#include <Wire.h>

const uint8_t ADXL345 = 0x53, BW_RATE = 0x2C, POWER_CTL = 0x2D, DATA_FORMAT = 0x31, DATAX0 = 0x32;
const uint32_t PERIOD_US = 2500;
uint16_t count = 0;
uint32_t due_us;

void set(uint8_t where, uint8_t what) {
  Wire.beginTransmission(ADXL345);
  Wire.write(where);
  Wire.write(what);
  Wire.endTransmission();
}

void setup() {
  Serial.begin(115200);
  Wire.begin();
  Wire.setClock(400000);
  set(BW_RATE, 0x0D);      // 800 Hz
  set(DATA_FORMAT, 0x0B);  // full resolution, +-16 g
  set(POWER_CTL, 0x08);    // measure
  Serial.println(F("n,ax,ay,az"));
  due_us = micros();
}

void loop() {
  while ((int32_t)(micros() - due_us) < 0) {
  }
  due_us += PERIOD_US;
  Wire.beginTransmission(ADXL345);
  Wire.write(DATAX0);
  Wire.endTransmission(false);
  Wire.requestFrom(ADXL345, (uint8_t)6);
  Serial.print(count++);
  for (int axis = 0; axis < 3; axis++) {
    int16_t low = Wire.read(), value = low | Wire.read() << 8;
    Serial.print(',');
    Serial.print(value);
  }
  Serial.println();
}
