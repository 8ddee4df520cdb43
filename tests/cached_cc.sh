#!/bin/bash
# Compile as $REAL_CC does; keep objects in $STEWART_OBJECTS by their preprocessed source.
# make ends a command with "-o OBJECT". With -P the source has no line of its folder, which -g adds.
case " $* " in *" -c "*) ;; *) exec $REAL_CC "$@" ;; esac
command=("${@:1:$#-2}")
key=$({ echo "${command[@]}"; $REAL_CC "${command[@]}" -E -P; } | sha256sum)
kept=$STEWART_OBJECTS/${key%% *}.o
if [ ! -f "$kept" ]; then
    $REAL_CC "${command[@]}" -o "$kept.$$" || exit 1
    mv "$kept.$$" "$kept"
fi
cp "$kept" "${!#}"
