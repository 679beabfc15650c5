#!/bin/sh
# Starts the station with the add-on's options. The library is in /data, which backups hold, too.
set -eu
SURFACED_TOKEN="$(jq -r .token /data/options.json)"
export SURFACED_TOKEN
[ -e /config/station.toml ] || cp /etc/surfaced/station.toml /config/
exec surfaced run --config /config/station.toml --library /data/library --create --serve 0.0.0.0:8080
