//! Names the surface a sensorised stylus is dragged over.
