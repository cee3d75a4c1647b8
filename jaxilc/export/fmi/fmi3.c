/* The functions of FMI 3.0 for co-simulation, around a block: see block.h. */
#include "block.h"
#include "state.h"

#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

typedef void *Component;
typedef void *State;
typedef uint32_t Reference;
typedef int Status; /* OK, Warning, Discard, Error, Fatal */
typedef const char *String;
typedef void (*Log)(void *environment, Status status, String category, String message);

enum { OK = 0, WRONG = 3 };

typedef struct {
    block block;
    Log log;
    void *environment;
} Instance;

static Status wrong(Component c, const char *what)
{
    Instance *it = c;
    if (it->log) {
        it->log(it->environment, WRONG, "logStatusError", what);
    }
    return WRONG;
}

BLOCK_EXPORT const char *fmi3GetVersion(void) { return "3.0"; }

BLOCK_EXPORT Status fmi3SetDebugLogging(Component c, bool on, size_t count, const String names[])
{
    (void) c, (void) on, (void) count, (void) names;
    return OK;
}

BLOCK_EXPORT Component fmi3InstantiateCoSimulation(
    String name, String token, String resources, bool visible, bool logging, bool events,
    bool early, const Reference between[], size_t count, void *environment, Log log, void *update)
{
    (void) name, (void) resources, (void) visible, (void) logging, (void) events, (void) early;
    (void) between, (void) count, (void) update;
    if (!token || strcmp(token, BLOCK_TOKEN) != 0) {
        return NULL; /* the description of another FMU */
    }
    Instance *it = calloc(1, sizeof *it);
    if (it) {
        it->log = log;
        it->environment = environment;
        block_start(&it->block);
    }
    return it;
}

BLOCK_EXPORT Component fmi3InstantiateModelExchange(String name, String token, String resources,
                                                    bool visible, bool logging, void *environment,
                                                    Log log)
{
    (void) name, (void) token, (void) resources, (void) visible, (void) logging;
    (void) environment, (void) log;
    return NULL;
}

BLOCK_EXPORT Component fmi3InstantiateScheduledExecution(
    String name, String token, String resources, bool visible, bool logging, void *environment,
    Log log, void *clock, void *lock, void *unlock)
{
    (void) name, (void) token, (void) resources, (void) visible, (void) logging;
    (void) environment, (void) log, (void) clock, (void) lock, (void) unlock;
    return NULL;
}

BLOCK_EXPORT void fmi3FreeInstance(Component c) { free(c); }

BLOCK_EXPORT Status fmi3EnterInitializationMode(Component c, bool tolerant, double tolerance,
                                                double start, bool ends, double stop)
{
    (void) tolerant, (void) tolerance, (void) ends, (void) stop;
    ((Instance *) c)->block.time = start;
    return OK;
}

BLOCK_EXPORT Status fmi3ExitInitializationMode(Component c) { return (void) c, OK; }
BLOCK_EXPORT Status fmi3Terminate(Component c) { return (void) c, OK; }

BLOCK_EXPORT Status fmi3Reset(Component c)
{
    block_start(&((Instance *) c)->block);
    return OK;
}

#define ACCESS(Type, Value, member, count_of, first, writable)                                     \
    BLOCK_EXPORT Status fmi3Get##Type(Component c, const Reference at[], size_t n, Value x[],      \
                                      size_t m)                                                    \
    {                                                                                              \
        Instance *it = c;                                                                          \
        for (size_t i = 0; i < n && i < m; ++i) {                                                  \
            if (at[i] == BLOCK_TIME && sizeof(Value) == sizeof(double)) {                          \
                x[i] = (Value) it->block.time;                                                     \
                continue;                                                                          \
            }                                                                                      \
            if (!block_has(at[i], first, count_of)) {                                              \
                return wrong(c, "fmi3Get" #Type ": no such value reference");                      \
            }                                                                                      \
            x[i] = it->block.member[at[i] - (first)];                                              \
        }                                                                                          \
        return OK;                                                                                 \
    }                                                                                              \
    BLOCK_EXPORT Status fmi3Set##Type(Component c, const Reference at[], size_t n,                 \
                                      const Value x[], size_t m)                                   \
    {                                                                                              \
        Instance *it = c;                                                                          \
        for (size_t i = 0; i < n && i < m; ++i) {                                                  \
            if (!block_has(at[i], first, writable)) {                                              \
                return wrong(c, "fmi3Set" #Type ": that is no input");                             \
            }                                                                                      \
            it->block.member[at[i] - (first)] = x[i];                                              \
        }                                                                                          \
        return OK;                                                                                 \
    }

ACCESS(Float64, double, real, BLOCK_REALS, BLOCK_REAL, BLOCK_REAL_INPUTS)
ACCESS(Int32, int32_t, whole, BLOCK_WHOLES, BLOCK_WHOLE, 0u)
ACCESS(Boolean, bool, truth, BLOCK_TRUTHS, BLOCK_TRUTH, BLOCK_TRUTH_INPUTS)

BLOCK_EXPORT Status fmi3DoStep(Component c, double time, double step, bool no_way_back, bool *event,
                               bool *terminate, bool *early, double *last)
{
    (void) no_way_back;
    *event = *terminate = *early = false;
    *last = time;
    if (!block_steps(&((Instance *) c)->block, step)) {
        return wrong(c, BLOCK_WRONG_STEP);
    }
    *last = ((Instance *) c)->block.time = time + step;
    return OK;
}

STATE_FUNCTIONS(fmi3GetFMUState, fmi3SetFMUState, fmi3FreeFMUState, fmi3SerializedFMUStateSize,
                fmi3SerializeFMUState, fmi3DeserializeFMUState, uint8_t)

BLOCK_EXPORT Status fmi3GetNumberOfVariableDependencies(Component c, Reference of, size_t *count)
{
    (void) of, (void) count;
    return wrong(c, "fmi3GetNumberOfVariableDependencies: not told");
}

/* What this FMU does not have: variables of other types, clocks, events, continuous states and
 * derivatives. A tool must not call these, and finds them, since a library has to have them all. */
#define NOT_HERE(name)                                                                             \
    BLOCK_EXPORT Status name(Component c) { return wrong(c, #name ": not in this FMU"); }

NOT_HERE(fmi3EnterEventMode)
NOT_HERE(fmi3EnterStepMode)
NOT_HERE(fmi3EnterConfigurationMode)
NOT_HERE(fmi3ExitConfigurationMode)
NOT_HERE(fmi3EnterContinuousTimeMode)
NOT_HERE(fmi3EvaluateDiscreteStates)
NOT_HERE(fmi3UpdateDiscreteStates)
NOT_HERE(fmi3GetVariableDependencies)
NOT_HERE(fmi3GetDirectionalDerivative)
NOT_HERE(fmi3GetAdjointDerivative)
NOT_HERE(fmi3GetOutputDerivatives)
NOT_HERE(fmi3GetIntervalDecimal)
NOT_HERE(fmi3GetIntervalFraction)
NOT_HERE(fmi3GetShiftDecimal)
NOT_HERE(fmi3GetShiftFraction)
NOT_HERE(fmi3SetIntervalDecimal)
NOT_HERE(fmi3SetIntervalFraction)
NOT_HERE(fmi3SetShiftDecimal)
NOT_HERE(fmi3SetShiftFraction)
NOT_HERE(fmi3CompletedIntegratorStep)
NOT_HERE(fmi3SetTime)
NOT_HERE(fmi3SetContinuousStates)
NOT_HERE(fmi3GetContinuousStates)
NOT_HERE(fmi3GetContinuousStateDerivatives)
NOT_HERE(fmi3GetEventIndicators)
NOT_HERE(fmi3GetNominalsOfContinuousStates)
NOT_HERE(fmi3GetNumberOfEventIndicators)
NOT_HERE(fmi3GetNumberOfContinuousStates)
NOT_HERE(fmi3ActivateModelPartition)

#define NO_VARIABLES(Type)                                                                         \
    NOT_HERE(fmi3Get##Type)                                                                        \
    NOT_HERE(fmi3Set##Type)

NO_VARIABLES(Float32)
NO_VARIABLES(Int8)
NO_VARIABLES(UInt8)
NO_VARIABLES(Int16)
NO_VARIABLES(UInt16)
NO_VARIABLES(UInt32)
NO_VARIABLES(Int64)
NO_VARIABLES(UInt64)
NO_VARIABLES(String)
NO_VARIABLES(Binary)
NO_VARIABLES(Clock)
