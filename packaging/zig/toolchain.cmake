# Compile with `zig cc` for another system: packaging/wheels.py sets these variables and writes the
# two compiler scripts.
set(CMAKE_SYSTEM_NAME $ENV{HASELAB_SYSTEM})
set(CMAKE_SYSTEM_PROCESSOR $ENV{HASELAB_PROCESSOR})
foreach(program C_COMPILER:cc CXX_COMPILER:c++ AR:ar RANLIB:ranlib RC_COMPILER:rc)
  string(REPLACE ":" ";" pair ${program})
  list(GET pair 0 variable)
  list(GET pair 1 name)
  set(CMAKE_${variable} $ENV{HASELAB_TOOLS}/${name})
endforeach()
set(CMAKE_MODULE_LINKER_FLAGS_INIT "-s") # no symbols for a debugger
set(CMAKE_FIND_ROOT_PATH_MODE_PROGRAM NEVER)
