#!/bin/bash
# Compile as $REAL_CC does; keep objects in $STEWART_OBJECTS by options and preprocessed source.
# make ends a command with "SOURCE -o OBJECT".
case " $* " in *" -c "*) ;; *) exec $REAL_CC "$@" ;; esac
set -o pipefail
command=("${@:1:$#-2}")
options=("$REAL_CC") read=()
for one in "${command[@]}"; do
    case $one in -D*) ;; *) options+=("$one") ;; esac # counts where the source uses it
    case $one in -g*) ;; *) read+=("$one") ;; esac # would write the folder into the source
done
kept=$({ echo "${options[@]}" && $REAL_CC "${read[@]}" -E; } | sha256sum) || exit 1
kept=$STEWART_OBJECTS/${kept%% *}.o
if [ ! -f "$kept" ]; then
    exec {lock}>"$kept.lock"
    flock "$lock" # of two workers one compiles
    if [ ! -f "$kept" ]; then
        $REAL_CC "${command[@]}" -o "$kept.$$" || exit 1
        mv "$kept.$$" "$kept"
    fi
fi
cp "$kept" "${!#}"
