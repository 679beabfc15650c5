//! Takes in what the stations publish.

use rumqttc::{Event, MqttOptions, Packet, QoS};
use serde_json::Value;

use super::Fleet;
use crate::outputs::BackOff;
use crate::outputs::broker::Line;
use crate::station::config::is_segment;

/// Subscribes for ever, and connects anew where the line breaks. A message is acknowledged once it is
/// on disk.
pub(super) async fn subscribe(fleet: &Fleet, options: &MqttOptions, prefix: &str) {
    let mut back_off = BackOff::new();
    loop {
        let mut line = Line::open(options.clone());
        let why = loop {
            match line.events.recv().await {
                Some(Ok(Event::Incoming(Packet::ConnAck(_)))) => {
                    for what in ["answer", "state"] {
                        let topics = format!("{prefix}/+/{what}");
                        // A new line has room.
                        let _ = line.client.try_subscribe(topics, QoS::AtLeastOnce);
                    }
                }
                Some(Ok(Event::Incoming(Packet::SubAck(_)))) => {
                    back_off.reset();
                    if fleet.lock().problem.take().is_some() {
                        tracing::info!("connected to the broker");
                    }
                }
                Some(Ok(Event::Incoming(Packet::Publish(message)))) => {
                    if let Err(why) = take(fleet, prefix, &message.topic, &message.payload) {
                        tracing::warn!("{}: this message is passed over: {why}", message.topic);
                    }
                    let _ = line.client.ack(&message).await;
                }
                Some(Ok(_)) => {}
                Some(Err(error)) => break error.to_string(),
                None => break "the connection ended".into(),
            }
        };
        let before = fleet.lock().problem.replace(why.clone());
        if before.is_none_or(|before| before == "connecting") {
            tracing::warn!("the broker is not connected: {why}; it is tried again");
        }
        tokio::time::sleep(back_off.next()).await;
    }
}

fn take(fleet: &Fleet, prefix: &str, topic: &str, payload: &[u8]) -> Result<(), String> {
    let below = topic.strip_prefix(prefix).and_then(|rest| rest.strip_prefix('/'));
    let (station, what) = below.and_then(|rest| rest.split_once('/')).unwrap_or_default();
    if !is_segment(station) {
        return Err("the name of its station holds more than letters, digits, `-` and `_`".into());
    }
    // An empty one takes a retained message back.
    if payload.is_empty() {
        return Ok(());
    }
    let said: Value = serde_json::from_slice(payload).map_err(|error| error.to_string())?;
    let inner = &mut *fleet.lock();
    match what {
        "state" => inner.stations.stated(station, said.as_object().ok_or("it is no JSON object")?),
        _ => {
            if let Some(head) = inner.cache.add(station, &said)? {
                inner.stations.answered(&head);
            }
        }
    }
    Ok(())
}
