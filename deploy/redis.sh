#!/bin/sh
# Starts the broker with one user that can do what a queue needs, its lock scripts included: no settings, files, or other
# administration.
set -eu
umask 077
rights='-@all +@read +@write +@connection +@transaction +@pubsub +@blocking -@dangerous +info +time +eval +evalsha +script|load'
printf 'user default off\nuser linna on >%s ~* &* %s\n' "$(cat /run/secrets/broker_password)" "$rights" > /tmp/users.acl
exec redis-server --aclfile /tmp/users.acl --appendonly yes "$@"
