// Alarms of fauio, with nothing but Zenoh: what stands, then what changes. Prints the JSON as it comes.
//
// Needs zenoh-c 1.x (the API of 0.x was another one):
//
//     cc subscribe.c -o subscribe -lzenohc
//     ./subscribe '["tcp/127.0.0.1:7447"]'
//
// Zenoh looks for a lost connection again by itself, and the subscriptions come back with it. An event may come twice,
// by its key and in the list of those that stand: of two with the same "id" and "seq" drop one.

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "zenoh.h"

static z_owned_session_t session;

static void print_line(const char *what, const z_loaned_sample_t *sample) {
    z_view_string_t key;
    z_keyexpr_as_view_string(z_sample_keyexpr(sample), &key);
    z_owned_string_t payload;
    z_bytes_to_string(z_sample_payload(sample), &payload);
    printf("%s %.*s %.*s\n", what, (int)z_string_len(z_loan(key)), z_string_data(z_loan(key)),
           (int)z_string_len(z_loan(payload)), z_string_data(z_loan(payload)));
    fflush(stdout);
    z_drop(z_move(payload));
}

static void on_event(z_loaned_sample_t *sample, void *context) {
    (void)context;
    print_line("changed", sample);
}

static void on_standing(z_loaned_reply_t *reply, void *context) {
    (void)context;
    if (z_reply_is_ok(reply)) {
        print_line("stand", z_reply_ok(reply));
    }
}

// The monitor's liveliness token: fauio/<vehicle>/live. When it appears, ask for fauio/<vehicle>/alarms.
static void on_token(z_loaned_sample_t *sample, void *context) {
    (void)context;
    if (z_sample_kind(sample) == Z_SAMPLE_KIND_DELETE) {
        print_line("monitor gone", sample);
        return;
    }
    print_line("monitor there", sample);
    z_view_string_t token;
    z_keyexpr_as_view_string(z_sample_keyexpr(sample), &token);
    char text[256];
    int kept = (int)z_string_len(z_loan(token)) - (int)strlen("live");
    int length = snprintf(text, sizeof text, "%.*salarms", kept, z_string_data(z_loan(token)));
    z_view_keyexpr_t key;
    if (length >= (int)sizeof text || z_view_keyexpr_from_str(&key, text) != Z_OK) {
        return;
    }
    z_owned_closure_reply_t answer;  // a callback: waiting here would hold up the session that brings the answer
    z_closure(&answer, on_standing, NULL, NULL);
    z_get(z_loan(session), z_loan(key), "", z_move(answer), NULL);
}

static int set(z_owned_config_t *config, const char *key, const char *value) {
    if (zc_config_insert_json5(z_loan_mut(*config), key, value) == Z_OK) {
        return 0;
    }
    fprintf(stderr, "%s: %s is not understood; endpoints are written [\"tcp/127.0.0.1:7447\"]\n", key, value);
    return -1;
}

int main(int argc, char **argv) {
    const char *endpoints = argc > 1 ? argv[1] : "[\"tcp/127.0.0.1:7447\"]";
    z_owned_config_t config;
    z_config_default(&config);
    if (set(&config, "connect/endpoints", endpoints) || set(&config, "connect/timeout_ms", "-1") ||
        set(&config, "connect/exit_on_failure", "false") || set(&config, "listen/endpoints", "[]") ||
        set(&config, "connect/retry", "{period_init_ms: 200, period_max_ms: 500, period_increase_factor: 1.5}") ||
        set(&config, "scouting/multicast/enabled", "false")) {
        return 2;
    }
    if (z_open(&session, z_move(config), NULL) != Z_OK) {
        fprintf(stderr, "cannot open a Zenoh session\n");
        return 1;
    }

    z_view_keyexpr_t events_key, tokens_key;
    z_view_keyexpr_from_str(&events_key, "fauio/*/alarm/**");
    z_view_keyexpr_from_str(&tokens_key, "fauio/*/live");

    // First subscribe, then ask: nothing falls between the two.
    z_owned_closure_sample_t take;
    z_owned_subscriber_t events, tokens;
    z_closure(&take, on_event, NULL, NULL);
    if (z_declare_subscriber(z_loan(session), &events, z_loan(events_key), z_move(take), NULL) != Z_OK) {
        return 1;
    }
    z_liveliness_subscriber_options_t options;
    z_liveliness_subscriber_options_default(&options);
    options.history = true;  // monitors that are there already, too
    z_closure(&take, on_token, NULL, NULL);
    if (z_liveliness_declare_subscriber(z_loan(session), &tokens, z_loan(tokens_key), z_move(take), &options) != Z_OK) {
        return 1;
    }

    while (getchar() != EOF) {
    }
    z_drop(z_move(tokens));
    z_drop(z_move(events));
    z_drop(z_move(session));
    return 0;
}
