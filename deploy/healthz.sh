#!/bin/bash
# A container's health check: does this container's own /healthz say 200? By bash alone, so that the image needs no client.
set -eu
exec 3<>"/dev/tcp/127.0.0.1/$1"
printf 'GET /healthz HTTP/1.0\r\nHost: localhost\r\n\r\n' >&3
read -r _ status _ <&3
[ "$status" = 200 ]
