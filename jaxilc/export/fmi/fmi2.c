/* The functions of FMI 2.0 for co-simulation, around a block: see block.h. */
#include "block.h"
#include "state.h"

#include <math.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

typedef void *Component;
typedef void *State;
typedef unsigned int Reference;
typedef int Status; /* OK, Warning, Discard, Error, Fatal, Pending */
typedef const char *String;
typedef struct {
    void (*logger)(void *environment, String name, Status status, String category, String message,
                   ...);
    void *(*allocate)(size_t count, size_t size);
    void (*release)(void *memory);
    void (*finished)(void *environment, Status status);
    void *environment;
} Callbacks;

enum { OK = 0, WRONG = 3 };

typedef struct {
    block block;
    const Callbacks *callbacks;
    char name[64];
} Instance;

static Status wrong(Instance *it, const char *what)
{
    if (it->callbacks && it->callbacks->logger) {
        it->callbacks->logger(it->callbacks->environment, it->name, WRONG, "logStatusError", "%s",
                              what);
    }
    return WRONG;
}

BLOCK_EXPORT const char *fmi2GetTypesPlatform(void) { return "default"; }
BLOCK_EXPORT const char *fmi2GetVersion(void) { return "2.0"; }

BLOCK_EXPORT Status fmi2SetDebugLogging(Component c, int on, size_t count, const String names[])
{
    (void) c, (void) on, (void) count, (void) names;
    return OK;
}

BLOCK_EXPORT Component fmi2Instantiate(String name, int type, String guid, String resources,
                                       const Callbacks *callbacks, int visible, int logging)
{
    (void) resources, (void) visible, (void) logging;
    if (type != 1 || !guid || strcmp(guid, BLOCK_TOKEN) != 0) {
        return NULL; /* no co-simulation, or the description of another FMU */
    }
    Instance *it = calloc(1, sizeof *it);
    if (it) {
        it->callbacks = callbacks;
        snprintf(it->name, sizeof it->name, "%s", name ? name : BLOCK_NAME);
        block_start(&it->block);
    }
    return it;
}

BLOCK_EXPORT void fmi2FreeInstance(Component c) { free(c); }

BLOCK_EXPORT Status fmi2SetupExperiment(Component c, int tolerant, double tolerance, double start,
                                        int ends, double stop)
{
    (void) c, (void) tolerant, (void) tolerance, (void) start, (void) ends, (void) stop;
    return OK;
}

BLOCK_EXPORT Status fmi2EnterInitializationMode(Component c) { return (void) c, OK; }
BLOCK_EXPORT Status fmi2ExitInitializationMode(Component c) { return (void) c, OK; }
BLOCK_EXPORT Status fmi2Terminate(Component c) { return (void) c, OK; }

BLOCK_EXPORT Status fmi2Reset(Component c)
{
    block_start(&((Instance *) c)->block);
    return OK;
}

#define ACCESS(Type, Value, member, count_of, first, writable)                                     \
    BLOCK_EXPORT Status fmi2Get##Type(Component c, const Reference at[], size_t n, Value x[])      \
    {                                                                                              \
        Instance *it = c;                                                                          \
        for (size_t i = 0; i < n; ++i) {                                                           \
            if (!block_has(at[i], first, count_of)) {                                              \
                return wrong(it, "fmi2Get" #Type ": no such value reference");                     \
            }                                                                                      \
            x[i] = it->block.member[at[i] - (first)];                                              \
        }                                                                                          \
        return OK;                                                                                 \
    }                                                                                              \
    BLOCK_EXPORT Status fmi2Set##Type(Component c, const Reference at[], size_t n,                 \
                                      const Value x[])                                             \
    {                                                                                              \
        Instance *it = c;                                                                          \
        for (size_t i = 0; i < n; ++i) {                                                           \
            if (!block_has(at[i], first, writable)) {                                              \
                return wrong(it, "fmi2Set" #Type ": that is no input");                            \
            }                                                                                      \
            it->block.member[at[i] - (first)] = x[i];                                              \
        }                                                                                          \
        return OK;                                                                                 \
    }

ACCESS(Real, double, real, BLOCK_REALS, BLOCK_REAL, BLOCK_REAL_INPUTS)
ACCESS(Integer, int, whole, BLOCK_WHOLES, BLOCK_WHOLE, 0u)
ACCESS(Boolean, int, truth, BLOCK_TRUTHS, BLOCK_TRUTH, BLOCK_TRUTH_INPUTS)

BLOCK_EXPORT Status fmi2GetString(Component c, const Reference at[], size_t n, String x[])
{
    (void) at, (void) x;
    return n ? wrong(c, "fmi2GetString: there are no texts") : OK;
}

BLOCK_EXPORT Status fmi2SetString(Component c, const Reference at[], size_t n, const String x[])
{
    (void) at, (void) x;
    return n ? wrong(c, "fmi2SetString: there are no texts") : OK;
}

BLOCK_EXPORT Status fmi2DoStep(Component c, double time, double step, int no_way_back)
{
    (void) time, (void) no_way_back;
    return block_steps(&((Instance *) c)->block, step) ? OK : wrong(c, BLOCK_WRONG_STEP);
}

BLOCK_EXPORT Status fmi2CancelStep(Component c) { return wrong(c, "fmi2CancelStep: not pending"); }

STATE_FUNCTIONS(fmi2GetFMUstate, fmi2SetFMUstate, fmi2FreeFMUstate, fmi2SerializedFMUstateSize,
                fmi2SerializeFMUstate, fmi2DeSerializeFMUstate, char)

BLOCK_EXPORT Status fmi2GetDirectionalDerivative(Component c, const Reference of[], size_t n,
                                                 const Reference by[], size_t m, const double dv[],
                                                 double found[])
{
    (void) of, (void) n, (void) by, (void) m, (void) dv, (void) found;
    return wrong(c, "fmi2GetDirectionalDerivative: there is none");
}

BLOCK_EXPORT Status fmi2SetRealInputDerivatives(Component c, const Reference at[], size_t n,
                                                const int order[], const double x[])
{
    (void) at, (void) n, (void) order, (void) x;
    return wrong(c, "fmi2SetRealInputDerivatives: inputs are held between samples");
}

BLOCK_EXPORT Status fmi2GetRealOutputDerivatives(Component c, const Reference at[], size_t n,
                                                 const int order[], double x[])
{
    (void) at, (void) n, (void) order, (void) x;
    return wrong(c, "fmi2GetRealOutputDerivatives: outputs are held between samples");
}

#define NO_STATUS(Kind, Value)                                                                     \
    BLOCK_EXPORT Status fmi2Get##Kind##Status(Component c, int kind, Value *value)                 \
    {                                                                                              \
        (void) kind, (void) value;                                                                 \
        return wrong(c, "fmi2Get" #Kind "Status: a step is done when fmi2DoStep returns");         \
    }

NO_STATUS(, Status)
NO_STATUS(Real, double)
NO_STATUS(Integer, int)
NO_STATUS(Boolean, int)
NO_STATUS(String, String)
