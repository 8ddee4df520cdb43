#!/bin/bash
# Compile as $REAL_CC does; keep objects in $STEWART_OBJECTS by options, source and included headers.
# make ends a command with "SOURCE -o OBJECT". The names of the headers are kept by options and source.
case " $* " in *" -c "*) ;; *) exec $REAL_CC "$@" ;; esac
command=("${@:1:$#-2}")
key() { { echo "${command[@]}"; cat "$@"; } | sha256sum; }
names=$(key "${command[-1]}")
names=$STEWART_OBJECTS/${names%% *}.names
if [ ! -f "$names" ]; then
    $REAL_CC "${command[@]}" -MM -MF "$names.$$" || exit 1
    mv "$names.$$" "$names"
fi
read -d "" -a files <"$names" # OBJECT: SOURCE HEADERS, on lines that end with a backslash
kept=$(key "${files[@]:1}")
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
